"""Controllers from models: what an effect adds to the linear model (linear_effects), the gains (lqi), and how far the
model may be wrong before they fail (robustness)."""
