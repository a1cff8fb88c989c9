"""Fuzzing: rubbish into everything that reads what others wrote; each input is used, or refused with a remedy.

In the order in which an input passes through it: `mutation` (inputs from valid ones), `target` (what is fuzzed, as
data), `targets` (the table), `trial` (one input after another, and what became of them), `worker` (a trial in a process
of its own, which may crash or hang), `table` (`make fuzz`).
"""
