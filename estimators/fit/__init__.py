"""The fit of a model by maximum likelihood: problem is model and data, innovations the noise as a Kalman gain,
likelihood what both are worth, gauss_newton the steps, logarithms and long_run parts of these; result is an estimate,
disturbance and sensor_errors the random parts of it, released what is estimated though the model holds it."""
