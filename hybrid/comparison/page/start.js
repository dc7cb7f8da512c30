startChart(report.pictures ? startViewer(report.pictures) : null);
if (report.loops) startLoops(report.loops);
