"""Estimators of whole recordings, one method a file: functions that return an estimators.contract.Estimate."""
