"""Logs of calibration runs: from bags and tables to rows that a fit can use."""
