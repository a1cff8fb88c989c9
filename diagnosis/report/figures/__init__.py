"""Figures of reports and of --picture: one module a result, drawn by drawing and matplotlib."""
