"""Touch: what pressures, loads and friction do not explain of the shape is a force.

`der_planner.estimation.force` says which force, and where it acts. Without contact what a model
lacks is not zero either (`der_planner.estimation.free_level`). A distance from that free level
which noise would pass once in an hour is a touch. A seventh of it is a suspicion: friction may hide
a light touch for seconds.

A payload is told apart from a touch in this way: it begins at once to pull at the tip along
gravity, and goes on. It is weighed, and is part of the free level from then on; one that is taken
off leaves it again. A fixed obstacle may push the same way, but no faster than the limb is driven
against it. Where gravity does not act in the plane, a payload cannot be told.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import replace

import numpy as np

from der_planner.arrays import Array
from der_planner.estimation.force import (
    EFFECT_WRONG,
    UNLIKELY,
    Touch,
    effects,
    exceeded,
    locate,
    untouched,
)
from der_planner.estimation.free_level import FreeLevel, Lacking
from der_planner.estimation.knowledge import Knowledge
from der_planner.estimation.nominal import Nominal
from der_planner.model import CONTROL_PERIOD, RodModel

_HOUR = 3600.0
_CORRELATED = 0.3
"""Time after which what the model lacks says something new [s]."""
_SWINGS = 0.1
"""Time in which swings are left out of the bends' rates [s]."""
_INERTIA_WRONG = 0.5
"""Standard deviation of the pressure that makes the limb's mass swing, over that pressure."""
_FOLLOWS = 0.3
"""Time in which the estimator follows what it did not expect, as friction that turned round [s]."""
_RELEASED = 0.5
"""Share of the threshold below which a touch ends."""
_SUSPECTED = 0.15
"""Share of the threshold from which on something may touch that friction hides: corrections do not
grow then."""
_LEARNED_AFTER = 0.4
"""An instant is learned as free only so long after it [s]: not if a touch is noticed meanwhile."""
_TOUCHED_FORGETS = 0.1
"""During a touch the free level is forgotten at this share of the usual speed, so that the end of
the touch can be told."""
_EARLIER = 4
"""Number of touches whose free levels are kept."""
_LONGEST = 1.0
"""Time between two pictures of which something is learned, at most [s]."""
_AT_ONCE = 0.5
"""Time over which what is lacking and pressures are compared when a touch is noticed [s]."""
_FASTER = 1.3
"""A payload changes what is lacking so many times faster than pressures do. Something fixed
cannot: it presses no faster than the limb is driven against it."""
_CAME = 0.3
"""Time in which a payload has come once it is noticed [s]."""
_WEIGHED = 0.7
"""Time for which a payload pulls the same [s]."""
_TOLD_BY = 4.0
"""Time after which a touch is no payload [s]."""
_PAYLOAD_WRONG = 0.2
"""Standard deviation of a payload that was weighed, over it: friction bears a part."""
_SAME_WEIGHT = 0.3
"""Change of the pull, over it, up to which it is the same."""
_LEAST_GRAVITY = 1.0
"""In the plane, for which payloads are told [m/s²]."""
_PLACES = 60
"""Places along the limb that are tried."""


class TouchSense:
    """Watches what the model lacks of a limb; see the module.

    Args:
        model: rod of the limb.
        free: what is known of the limb without contact.
    """

    def __init__(self, model: RodModel, free: FreeLevel | None = None) -> None:
        self._model = model
        self._has_weight = float(np.hypot(*model.limb.gravity[:2])) > _LEAST_GRAVITY
        self.free = free or FreeLevel(model.limb)
        limb = model.limb
        self._places = np.linspace(limb.base_length, limb.length, _PLACES + 1)[1:]
        self.threshold = exceeded(_CORRELATED / _HOUR, model.inputs + 2)
        self.newest = untouched(-np.inf, np.zeros(model.inputs))
        self._rate, self._slid = np.zeros((2, model.inputs))
        self._stuck, self._swung = np.zeros((2, model.inputs)), np.zeros(model.inputs + 2)
        self._recent: deque[tuple[Lacking, float, Array, Array]] = deque()
        self._lately: deque[Lacking] = deque()
        self._weighed: list[tuple[float, float, bool]] = []
        self._came_at_once = False
        self._noticed = np.zeros((model.inputs + 2, model.inputs + 2))
        self._learned = self._calm = -np.inf
        self._earlier: list[tuple[FreeLevel, float]] = []

    def feel(self, time: float, nominal: Nominal, known: Knowledge) -> Touch:
        """Return what a newer state of the estimator says of a touch.

        Args:
            time: [s].
            nominal: the model's motion.
            known: the filter's state then.
        """
        passed = min(time - self.newest.time, _LONGEST)
        bend, rate, _ = nominal.at(time)
        bend, rate = bend + known.parts[0], rate + known.parts[1]
        self._rate += (1.0 - np.exp(-passed / _SWINGS)) * (rate - self._rate)
        goes_on = self._rate * self._slid > 0.0
        self._slid = np.where(goes_on, self._slid, 0.0) + passed * rate
        lacking = Lacking.of(time, self._model.limb, known, bend, self._rate, self._slid)
        # Doubts of friction and of the swinging mass fade no faster than the estimator follows.
        kept = np.exp(-passed / _FOLLOWS)
        least, most = lacking.stuck
        self._stuck = np.stack(
            [np.minimum(least, kept * self._stuck[0]), np.maximum(most, kept * self._stuck[1])]
        )
        swings = (rate - self._rate) / _SWINGS
        moved_by = nominal.mass[nominal.periods(round(time / CONTROL_PERIOD))] @ swings
        swung = np.append(_INERTIA_WRONG * moved_by, np.zeros(2)) ** 2
        self._swung = np.maximum(swung, kept**2 * self._swung)
        spread = lacking.covariance + np.diag(self._swung)
        return self.look(replace(lacking, stuck=self._stuck, covariance=spread))

    def look(self, lacking: Lacking) -> Touch:
        """Return what a newer instant says of a touch."""
        before = self.newest
        self._lately.append(lacking)
        while self._lately[0].time < lacking.time - _AT_ONCE:
            self._lately.popleft()
        away, variance = self._away(lacking, self.free, self._learned)
        distance = self._distance(away, away.covariance)
        touched = distance > (_RELEASED if before.touched else 1.0)
        if touched and self._return_to_earlier_level(lacking, variance):
            away, variance = self._away(lacking, self.free, self._learned)
            distance, touched = self._distance(away, away.covariance), False
        if distance < _RELEASED:
            self._calm = lacking.time
        passed = lacking.time - before.time
        if 0.0 < passed < _LONGEST:
            self._recent.append((lacking, passed, away.beside_friction, variance))
        if lacking.time - self._calm > _LEARNED_AFTER:
            self._recent.clear()
        since = before.since if before.touched else lacking.time
        if touched and not before.touched:
            self._noticed = lacking.covariance
        told = weighed = False
        if touched and self._has_weight:
            told, weighed = self._weigh(away, lacking.time - since)
        payload = self.free.payload
        if touched and not told:
            found = locate(self._model, away, self._places)
            said = found.said + (", or a payload" if weighed else "")
            found = replace(found, since=since, distance=distance, said=said)
        else:
            said = f"{1000 * payload:.0f} g more at the tip than planned" if payload else ""
            found = replace(untouched(lacking.time, lacking.bend_angles, distance), said=said)
        suspected = touched or self._suspects(away, distance)
        self.newest = replace(found, payload=payload, suspected=suspected)
        learned = lacking.time - _LEARNED_AFTER
        while not touched and self._recent and self._recent[0][0].time < learned:
            self._learned = self._recent[0][0].time
            self.free.learn(*self._recent.popleft())
        return self.newest

    def _away(self, lacking: Lacking, free: FreeLevel, learned: float) -> tuple[Lacking, Array]:
        """Return what is away from a free level, with its covariance, and the level's variance.

        Args:
            lacking: of the model.
            free: level.
            learned: when it was learned last [s].
        """
        ahead, touch = lacking.time - learned, self.newest
        if touch.touched:
            ahead -= (1.0 - _TOUCHED_FORGETS) * (lacking.time - touch.since)
        mean, variance = free.expected(lacking, ahead)
        value, covariance = lacking.value - mean, lacking.covariance + np.diag(variance)
        if free.payload:
            weight = free.payload * self._weight_effect(lacking.bend_angles)
            value -= weight
            covariance += _PAYLOAD_WRONG**2 * np.outer(weight, weight)
        return replace(lacking, value=value, covariance=covariance), variance

    def _distance(self, away: Lacking, noise: Array) -> float:
        """Return the squared distance from the free level, over that of a touch.

        What friction may hide of a touch that goes on does not end it. Nor does doubt that a swing
        brings after it was noticed.
        """
        left, doubts = away.beside_friction, [noise]
        if self.newest.touched:
            left = away.value
            doubts.append(noise + self._noticed - self._lately[-1].covariance)
        return float(max(left @ np.linalg.solve(each, left) for each in doubts)) / self.threshold

    def _suspects(self, away: Lacking, distance: float) -> bool:
        """Return whether something may touch that does not reach the threshold, or not any more.

        Friction must be able to bear most of it. What a segment that slides lacks is a wrong gain,
        which corrections are for. Friction that segments take up later does not end the suspicion.

        Args:
            away: from the free level, with the covariance of that.
            distance: see `_distance`.
        """
        if not self.newest.suspected:
            left = away.beside_friction[: away.stuck.shape[1]]
            most = int(np.argmax(np.abs(left)))
            return distance > _SUSPECTED and np.ptp(away.stuck[:, most]) > 2.0 * abs(left[most])
        whole = away.value @ np.linalg.solve(away.covariance, away.value) / self.threshold
        return max(distance, float(whole)) > _RELEASED * _SUSPECTED

    def _return_to_earlier_level(self, lacking: Lacking, variance: Array) -> bool:
        """Go back to an earlier free level if that explains the limb better; return whether.

        A force that had been learned has ended, or a payload is off. The noise is that of the
        newest level: one of which little is known would explain any touch.

        Args:
            lacking: of the model.
            variance: (M + 2,) of the newest free level.
        """
        for place, earlier in enumerate(self._earlier):
            away, told = self._away(lacking, *earlier)
            if self._distance(away, away.covariance + np.diag(variance - told)) < _RELEASED:
                left = self.free, self._learned
                self.free, self._learned = copy.deepcopy(earlier)
                del self._earlier[place + 1 :]
                if left[0].payload:  # it may only seem to be off
                    self._earlier.append(left)
                self._recent.clear()
                return True
        if not self.newest.touched:
            self._earlier.append((copy.deepcopy(self.free), self._learned))
            del self._earlier[:-_EARLIER]
        return False

    def _weight_effect(self, bend_angles: Array) -> Array:
        """Return what the weight of a kilogram at the tip makes the model lack (M + 2,)."""
        effect = effects(self._model, bend_angles, self._places[-1:])[0]
        weight: Array = effect @ np.array(self._model.limb.gravity[:2])
        return weight

    def _comes_at_once(self) -> bool:
        """Return whether what is lacking changed faster than pressures did."""
        first, last = self._lately[0], self._lately[-1]
        change = (last.value - first.value)[: len(last.effective)]
        driven = abs(float(change @ (last.effective - first.effective)))
        return float(change @ change) > _FASTER * driven

    def _weigh(self, away: Lacking, age: float) -> tuple[bool, bool]:
        """Return whether what touches is a payload, and whether it may yet turn out to be one.

        What is told to be one is added to the payload of the free level.

        Args:
            away: from the free level, with the covariance of that.
            age: of the touch [s].
        """
        if age == 0.0:
            self._weighed.clear()
            self._came_at_once = self._comes_at_once()
        weight = self._weight_effect(away.bend_angles)
        inverse = np.linalg.inv(away.doubtful + np.diag((EFFECT_WRONG * away.value) ** 2))
        pull = float(weight @ inverse @ weight)
        mass = float(weight @ inverse @ away.value) / pull
        left = float(away.value @ inverse @ away.value) - mass**2 * pull
        alone = left < exceeded(UNLIKELY**2, len(weight) - 1)
        self._weighed.append((age, mass, alone))
        ages, masses, alones = np.array(self._weighed).T
        newest = ages > age - _WEIGHED
        mean = float(masses[newest].mean())
        taken_off = mean + self.free.payload < -_SAME_WEIGHT * abs(mean)
        # What a hand presses with comes slowly, though the limb is not driven.
        grew = np.abs(masses[ages <= _CAME]).max() < (1.0 - _SAME_WEIGHT) * abs(mean)
        perhaps = self._came_at_once and age < _TOLD_BY and not (taken_off or grew)
        same = np.ptp(masses[newest]) < _SAME_WEIGHT * abs(mean)
        told = perhaps and same and bool(alones[newest].all()) and age > _WEIGHED
        if told:
            self.free.payload = max(0.0, self.free.payload + mean)
        return told, perhaps
