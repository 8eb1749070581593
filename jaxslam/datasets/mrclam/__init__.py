"""The UTIAS multi-robot data sets (MRCLAM): files, calibration, truth, reader."""
