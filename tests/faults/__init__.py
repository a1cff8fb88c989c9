"""The fault campaign: every fault as an entry of a table, injected in lock-step, measured from the truth.

In the order in which a fault passes through it: `bench` (the vehicle with places for faults), `fault` (an entry of the
table), `scenarios` (the table, by where the fault is), `outcome` (what happened), `verdict` (what is wrong with it),
`campaign` (all of them, in processes), `table` (`make faults`), `shortfalls` (what the product does not do yet).
"""
