"""Batch estimators for whole recordings, one method per file: functions that return an estimators.contract.Estimate."""
