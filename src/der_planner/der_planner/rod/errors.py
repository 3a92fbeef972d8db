"""What the rod raises when it cannot answer."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from der_planner.rod.state import RodState


class ConvergenceError(RuntimeError):
    """Newton's iteration did not converge; nothing wrong was returned.

    Attributes:
        step: index of the time step (or load step) that failed, 0 for a single step.
        residual: largest component of the last Newton update [m or rad].
        iterations: Newton iterations spent in the failed step.
        state: the last converged state, from which a caller may go on with a shorter step.
    """

    def __init__(
        self, message: str, *, step: int, residual: float, iterations: int, state: RodState
    ) -> None:
        super().__init__(message)
        self.step = step
        self.residual = residual
        self.iterations = iterations
        self.state = state
