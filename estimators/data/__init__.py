"""Preparation of recordings for fits: segments of usable samples (`segments`, `resting`), the sensors that a record
shows (`as_recorded`, `quantised`, `white_noise`), filters and instruments of regressions, and the time scale."""
