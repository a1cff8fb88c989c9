"""Recursive estimators, for use while the vehicle runs: frame_chunks turns control cycles into data, least_squares is
linear, prediction_error consists of predictor and gauss_newton."""
