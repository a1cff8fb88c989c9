"""For programs that look on: metrics for Prometheus, and cycles for Foxglove, Lichtblick and PlotJuggler."""
