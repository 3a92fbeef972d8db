"""What `run_experiment.py` is made of: processes, a client of the graph, trials, results."""
