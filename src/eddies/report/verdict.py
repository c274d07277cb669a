"""What the report of a run says first: whether the numbers are good, in words and beside those of baselines.

All rules are those of this module. What moved the particles, a network or a grid, is judged alike: by limits of each
measure or, where these are wider, by what samples of the truth itself show.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from eddies.report.page import Metric, Section

GOOD, FAIR, POOR = "good", "fair", "poor"
KEY = "verdict"
#: In this order the sections stand on the page; open are those that say how good the run is.
ORDER = ("variants", KEY, "rollout", "forced", "step", "model", "kernel", "cost", "ground_truth", "stationary",
         "tracers")
OPEN = ("variants", KEY, "rollout", "forced")

#: Up to which part of the baseline's error an error is good, and fair; beyond them it is poor.
BESIDE_NO_FORCE = BESIDE_GRADIENT = (0.2, 0.5)
BESIDE_TEXTBOOK = (0.95, 1.05)  # better than kernels that need no training, or as good
ENERGY = (0.03, 0.1)            # deviation from the truth's
SPECTRUM = (0.05, 0.2)          # rms of ln(E/E_filtered)
DIVERGENCE = (0.002, 0.02)      # nats; of a normal distribution whose deviation is 4 % off, and 14 %
FLOORS = (2.0, 5.0)             # times what samples of the truth itself show, where that is more
ASKED_OF_IT = 0.1               # least error of no force with which there is something to judge
BESIDE_IN_WORDS = {GOOD: "better than those that need no training", FAIR: "no better than those that need no training",
                   POOR: "worse than those that need no training"}
TEXTBOOK = {"cubic_spline": "cubic spline", "wendland": "Wendland"}


@dataclass(frozen=True)
class Judged:
    """A number with what it is judged by: an `error` that is good up to the first of two limits and fair up to the
    second, which `within` has in words; `words` for the table, `short` for sentences, `beside` the baseline in words.
    """

    key: str
    words: str
    short: str
    value: float
    error: float
    limits: tuple[float, float]
    beside: str = ""
    within: str = "≤{:.2g}"
    judged: bool = True

    @property
    def mark(self) -> str:
        """good, fair or poor; or that there is nothing to judge."""
        if not self.judged:
            return "not judged"
        return GOOD if self.error <= self.limits[0] else FAIR if self.error <= self.limits[1] else POOR

    @property
    def metric(self) -> Metric:
        """A row of the table."""
        good, fair = (self.within.format(limit) for limit in self.limits)
        return Metric(self.key, self.words, {"this run": self.value, "verdict": self.mark, "beside it": self.beside,
                                             "good": good, "fair": fair})


def arranged(sections: Sequence[Section], warned: bool) -> list[Section]:
    """All sections in the order of the page, the verdict first where there is something to judge; `warned`: whether the
    products of the run are such that the report warns of them."""
    found = {each.key: each for each in sections}
    judgement = [section(found, warned)] if found.keys() & {"rollout", "model", "kernel"} else []
    ordered = sorted([*judgement, *sections], key=lambda each: ORDER.index(each.key))
    for each in ordered:
        each.folded = each.key not in OPEN
    return ordered


def section(sections: Mapping[str, Section], warned: bool) -> Section:
    """The verdict on a run from the numbers of its sections, by key."""
    numbers = {key: {metric.key: metric.value for metric in each.metrics} for key, each in sections.items()}
    rollout, model, kernel = (numbers.get(key, {}) for key in ("rollout", "model", "kernel"))
    of_rollout, of_model, of_kernel = [*_rollout(rollout)], [*_model(model)], [*_kernel(kernel)]
    text = [*_on_rollout(rollout, of_rollout),
            *(f"{each.short} {each.value:.2g} ({each.beside}): {each.mark}." for each in of_model),
            *(f"{each.short} {BESIDE_IN_WORDS[each.mark]} ({each.value:.2g}; {each.beside})." for each in of_kernel)]
    if "forced" in sections:
        text.append("A forced flow is another one after a turnover or two: what averages say stands in the section on "
                    "the stationary state.")
    if warned:
        text.append("The warnings above come first: these numbers may not belong together.")
    return Section(KEY, "Verdict", " ".join(text), metrics=[each.metric for each in of_rollout + of_model + of_kernel])


def _on_rollout(numbers: Mapping[str, Any], judged: Sequence[Judged]) -> Iterator[str]:
    """Sentences on the rollout."""
    if not numbers:
        yield "There is no rollout to judge."
        return
    if not numbers.get("stable"):
        yield f"Poor: the rollout did not come to its end ({numbers.get('status')}). What is compared is from before."
    if numbers.get("two_flows"):
        yield "The rollout is not judged by the true tracers: they are forced otherwise, and so in another flow."
        return
    if not judged:
        yield "It cannot be compared with the truth."
        return
    marked = {mark: [each.short for each in judged if each.mark == mark] for mark in (POOR, FAIR, GOOD)}
    worst_first = [f"{mark} in {', '.join(those)}" for mark, those in marked.items() if those]
    everything = "all that it is judged by: " if len(worst_first) == 1 else ""
    yield f"The rollout is {'; '.join(worst_first)}.".replace(" in ", f" in {everything}", 1)
    if numbers["early_time"] < 0.5:
        yield f"It is compared for {numbers['early_time']:.2g} turnovers alone, which asks little of it."
    if not all(each.judged for each in judged):
        yield (f"Even without any force its velocities would be off by less than {ASKED_OF_IT:g}: it is too short to "
               "judge them.")


def _rollout(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    if numbers.get("two_flows"):
        return
    error, without = numbers.get("early_velocity_error"), numbers.get("early_velocity_error_no_force")
    if error is not None and without:
        limits = (BESIDE_NO_FORCE[0] * without, BESIDE_NO_FORCE[1] * without)
        yield Judged("velocity", f"velocity error by particle after {numbers['early_time']:.2g} T", "velocities", error,
                     error, limits, f"no force: {without:.2g}", judged=without >= ASKED_OF_IT)
    ratio, without = numbers.get("energy_ratio"), numbers.get("energy_ratio_no_force")
    if ratio is not None:
        yield Judged("energy", "kinetic energy at the end, model / truth", "energy", ratio, abs(ratio - 1), ENERGY,
                     "" if without is None else f"no force: {without:.3g}", "±{:.2g}")
    for key, words, short, limits in (
            ("spectrum_error", "spectrum error at the end, rms of ln(E/E_filtered)", "spectrum", SPECTRUM),
            ("acceleration_kl", "KL divergence of accelerations at the end", "accelerations", DIVERGENCE),
            ("qr_kl", "KL divergence of the Q–R plane at the end", "velocity gradients", DIVERGENCE)):
        error, floor = numbers.get(key), numbers.get(f"{key}_floor")
        if error is not None:
            raised = tuple(max(limit, times * (floor or 0.0)) for limit, times in zip(limits, FLOORS))
            yield Judged(key, words, short, error, error, raised, "" if floor is None else f"truth itself: {floor:.2g}")


def _model(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    error, gradient = numbers.get("acceleration_error"), numbers.get("filtered_pressure_gradient_error")
    if error is not None:
        baseline, beside = 1.0, "no model: 1"
        if gradient is not None and gradient < 1:
            baseline, beside = gradient, f"exact filtered pressure gradient: {gradient:.2g}"
        limits = (BESIDE_GRADIENT[0] * baseline, BESIDE_GRADIENT[1] * baseline)
        yield Judged("acceleration_error", "model: acceleration error at the true state",
                     "At the true state the model's accelerations have an error of", error, error, limits, beside)


def _kernel(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    for what in ("velocity", "gradient"):
        known = {key: numbers[f"{key}_{what}_error"] for key in TEXTBOOK if numbers.get(f"{key}_{what}_error")}
        error = numbers.get(f"{what}_error")
        if error is not None and known:
            best = min(known, key=lambda key: known[key])
            limits = (BESIDE_TEXTBOOK[0] * known[best], BESIDE_TEXTBOOK[1] * known[best])
            yield Judged(f"kernel_{what}_error", f"kernel: error of the {what} field",
                         f"In the {what} field the learned kernel is", error, error, limits,
                         f"{TEXTBOOK[best]}: {known[best]:.2g}")
