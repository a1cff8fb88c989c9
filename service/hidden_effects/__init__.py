"""The benchmark of hidden effects: how often what a virtual vehicle has and the model lacks is called by its name.

`cases` says what is asked, `trial` asks it, `spread` runs it on many cores or machines, `results` keeps it, `summary`
counts. `regressions` and `exhaustive` are the baselines that the diagnosis is held against.
"""
