"""Tables that others wrote (telemetry.formats), as recordings.

The files, in the order in which a table passes them: raw (the table as it is in its file), wanted and mapping (what a
model needs, and what the user says), several_clocks (one column of time), times (which one, and its unit), matched
(columns -> channels), stamps (what is wrong with the clock), several_rates (rows that channels share), read (all of
it).

Whatever is assumed is a sentence in `Recording.assumed`. What only physics can show, like an angle in degrees, is asked
in estimators.readings, and tried with assumed.
"""
