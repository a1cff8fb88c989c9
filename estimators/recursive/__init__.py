"""Estimates while the vehicle runs: frame_chunks are control cycles as data, least_squares and torque_balance linear,
predictor and gauss_newton what prediction_error is made of."""
