"""What a fit says of the random parts of its model: disturbances at joints, errors of outputs, noise of measured inputs
(models.random)."""
