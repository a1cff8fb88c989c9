"""Equations as text, never evaluated as code: what may stand in one (syntax), and its symbols and values
(expressions)."""
