"""Requests: the control socket (`server`), who may ask (`peers`, `lease`), and what is asked (`commands`)."""
