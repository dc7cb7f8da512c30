startChart(report.pictures ? startViewer(report.pictures) : null);
