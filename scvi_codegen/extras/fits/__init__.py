"""Parameter estimation: least squares, measurements, multiple shooting."""
