"""Work on finished recordings: replay reads and replays them, export converts them, machine finds which machine they
are of, next_experiment chooses what to record next, trail writes the result of a diagnosis."""
