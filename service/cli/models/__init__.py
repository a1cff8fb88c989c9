"""`upright model`: show, list and create models (shown), add and remove effects based on recordings (changed)."""
