"""Names of planning methods that are known where no plan is made: in runs, reports and requests."""

LEARNED = "learned"
"""The method of a plan that was learned; runs of an experiment add from how many runs it was."""
