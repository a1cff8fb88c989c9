"""The observer process and its client in control. The client starts it and feeds its pipe; the process records,
estimates online, predicts and diagnoses. The raw log is a separate process, which taps the bus."""
