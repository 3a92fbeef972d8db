"""Studies: one table of runs, played on the cores of a machine or on a cluster.

`study.Study` is a table read from YAML, `conduct.conduct` plays it on Dask and keeps each row as it
finishes, `report` draws and writes what came out.
"""
