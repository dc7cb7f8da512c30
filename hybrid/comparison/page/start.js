startChart(report.pictures ? startViewer(report.pictures) : null);
if (report.animations) startAnimations(report.animations);
