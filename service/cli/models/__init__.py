"""`upright model`: shown, listed and begun (shown), added to and taken from by what recordings say (changed)."""
