"""The observer process and its ends in control: the client starts it and feeds its pipe, the process records, estimates
online, predicts and diagnoses; the raw log is a process of its own, which taps the bus."""
