"""The fit of a model by maximum likelihood: problem (model and data), innovations (the noise as a Kalman gain),
likelihood, stationary_start (initial disturbances), gauss_newton (the steps), logarithms (steps in logarithms), result
(the estimate), random (what it says of random parts), released (held parameters that are estimated)."""
