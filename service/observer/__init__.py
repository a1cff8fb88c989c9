"""The observer process and its client in control. The client starts it and feeds its pipe (link, pipe); the process
records (recording/), estimates, predicts and diagnoses online (live/), and serves those who look on (viewers/)."""
