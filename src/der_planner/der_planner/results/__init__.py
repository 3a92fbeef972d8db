"""Results: from bags, or arrays of a run without one, to errors, tables and figures.

Example::

    run = load_run("bags/same_direction_der_optimal_trial1")  # or RunSeries.from_arrays(…)
    result = evaluate_run(run)
    print(format_table(summarise([result])))
    write_results([result], folder)  # folder/results.json
    plot_tip([run], folder)
    write_report([run], [result], folder)  # page, tables, every figure
"""

from der_planner.bags.reader import BagError
from der_planner.bags.run import Description, EvaluationError, RunSeries
from der_planner.bags.series import load_run
from der_planner.results.evaluation import RunResult, evaluate_bags, evaluate_run
from der_planner.results.figures import plot_error, plot_learning, plot_pressures, plot_tip
from der_planner.results.report import write_report, write_results
from der_planner.results.statistics import compare, summarise
from der_planner.results.tables import format_table

__all__ = [
    "BagError",
    "Description",
    "EvaluationError",
    "RunResult",
    "RunSeries",
    "compare",
    "evaluate_bags",
    "evaluate_run",
    "format_table",
    "load_run",
    "plot_error",
    "plot_learning",
    "plot_pressures",
    "plot_tip",
    "summarise",
    "write_report",
    "write_results",
]
