"""Figures of reports and of --picture: one module per result, drawn by drawing and matplotlib."""
