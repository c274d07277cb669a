"""The verdict of a report: it marks each main number as good, fair or poor.

Two limits, the largest good error and the largest fair error, are the same for all methods. A limit is a fixed number
or a multiple of the error of a baseline. Some errors are not zero even for samples of the truth. The limits of such an
error are at least a multiple of the value for the truth.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from eddies.report.page import Metric, Section

GOOD, FAIR, POOR = "good", "fair", "poor"
KEY = "verdict"
#: Keys of the sections in the order of the page (ORDER), and those of the sections that are not folded (OPEN).
ORDER = ("variants", KEY, "rollout", "forced", "step", "model", "reconstruction", "kernel", "cost", "ground_truth",
         "stationary", "tracers")
OPEN = ("variants", KEY, "rollout", "forced")

# Each pair holds the largest error that counts as good and the largest that counts as fair.
BESIDE_NO_FORCE = BESIDE_GRADIENT = (0.2, 0.5)  # times the error of the baseline
BESIDE_TEXTBOOK = (0.95, 1.05)  # times the error of the better kernel that needs no training
ENERGY = (0.03, 0.1)            # relative deviation from the truth
SPECTRUM = (0.05, 0.2)          # rms of ln(E/E_filtered)
DIVERGENCE = (0.002, 0.02)      # nats; values of two normal PDFs whose standard deviations differ by 4 % and by 14 %
FLOORS = (2.0, 5.0)             # times the error of samples of the truth itself
LEAST_BASELINE = 0.1            # velocities are judged if their error without any force is at least this
KERNEL_WORDS = {GOOD: "better than", FAIR: "about as good as", POOR: "worse than"}
TEXTBOOK = {"cubic_spline": "cubic spline", "wendland": "Wendland kernel"}


@dataclass(frozen=True)
class Judged:
    """A number of the report and its mark: good, fair or poor.

    `error` is compared with `good` and `fair`, the largest errors with these marks. `within` is the format of these two
    limits in the table. `words` is the name of the number in the table, and `short` its name in sentences.
    `baseline_text` describes the baseline. If `judged` is false, the number gets no mark.
    """

    key: str
    words: str
    short: str
    value: float
    error: float
    good: float
    fair: float
    baseline_text: str = ""
    within: str = "≤{:.2g}"
    judged: bool = True

    @property
    def mark(self) -> str:
        """Mark of the number: "good", "fair", "poor", or "not judged"."""
        if not self.judged:
            return "not judged"
        return GOOD if self.error <= self.good else FAIR if self.error <= self.fair else POOR

    @property
    def metric(self) -> Metric:
        """The row of this number in the table."""
        return Metric(self.key, self.words, {
            "this run": self.value, "verdict": self.mark, "for comparison": self.baseline_text,
            "good": self.within.format(self.good), "fair": self.within.format(self.fair)})


def arranged(sections: Sequence[Section], warned: bool) -> list[Section]:
    """Return the sections in the order of the page, with a verdict if there is something to judge.

    The sections that are not in OPEN are folded. warned: whether the report warns that products do not fit together.
    """
    found = {each.key: each for each in sections}
    judgement = [section(found, warned)] if found.keys() & {"rollout", "model", "kernel"} else []
    ordered = sorted([*judgement, *sections], key=lambda each: ORDER.index(each.key))
    for each in ordered:
        each.folded = each.key not in OPEN
    return ordered


def section(sections: Mapping[str, Section], warned: bool) -> Section:
    """Return the section with the verdict on a run. `sections` are the other sections of the page by key.

    warned: whether the report warns that products do not fit together.
    """
    numbers = {key: {metric.key: metric.value for metric in each.metrics} for key, each in sections.items()}
    rollout, model, kernel = (numbers.get(key, {}) for key in ("rollout", "model", "kernel"))
    of_rollout, of_model, of_kernel = [*_rollout(rollout)], [*_model(model)], [*_kernel(kernel)]
    text = [*_sentences(rollout, of_rollout),
            *(f"Model: {each.short} {each.value:.2g}, {each.mark} ({each.baseline_text})." for each in of_model),
            *(f"Learned kernel: {each.short} {each.value:.2g}, {KERNEL_WORDS[each.mark]} the "
              f"{each.baseline_text.replace(': ', ' (')})." for each in of_kernel)]
    if "forced" in sections:
        text.append("A forced flow differs from its truth after one or two turnovers. The section about the forced "
                    "rollout compares averages.")
    if warned:
        text.append("Read the warnings of this report first: these numbers may not belong together.")
    return Section(KEY, "Verdict", " ".join(text), metrics=[each.metric for each in of_rollout + of_model + of_kernel])


def _sentences(numbers: Mapping[str, Any], judged: Sequence[Judged]) -> Iterator[str]:
    """Yield sentences on the rollout. `numbers` are the values of its metrics, and `judged` their marks."""
    if not numbers:
        yield "There is no rollout to judge."
        return
    if not numbers.get("stable"):
        status = numbers.get("status")
        fault = "has values that are not finite" if status == "complete" else f"did not reach its end ({status})"
        yield f"Poor: the rollout {fault}. Only earlier frames are compared."
    if not judged:
        yield ("The rollout is not judged against the true tracers: its forcing differs from theirs, so they are in "
               "two different flows." if numbers.get("two_flows") else "The rollout cannot be compared with the truth.")
        return
    marked = {mark: [each.short for each in judged if each.mark == mark] for mark in (POOR, FAIR, GOOD)}
    worst_first = [f"{mark} in {', '.join(names)}" for mark, names in marked.items() if names]
    yield f"Rollout: {'; '.join(worst_first)}."
    if numbers["early_time"] < 0.5:
        yield f"It is compared over only {numbers['early_time']:.2g} turnovers, which is an easy test."
    if not all(each.judged for each in judged):
        yield (f"Velocities are not judged: the rollout is so short that their error without any force is below "
               f"{LEAST_BASELINE:g}.")


def _rollout(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    if numbers.get("two_flows") or numbers.get("energy_ratio") is None:
        return
    error, without = numbers["early_velocity_error"], numbers["early_velocity_error_no_force"]
    if error is not None and without:
        yield Judged("velocity", f"velocity error by particle after {numbers['early_time']:.2g} T", "velocities", error,
                     error, *(limit * without for limit in BESIDE_NO_FORCE), f"no force: {without:.2g}",
                     judged=without >= LEAST_BASELINE)
    ratio = numbers["energy_ratio"]
    yield Judged("energy", "kinetic energy at the end, model / truth", "energy", ratio, abs(ratio - 1), *ENERGY,
                 f"no force: {numbers['energy_ratio_no_force']:.3g}", "±{:.2g}")
    for key, words, short, limits in (
            ("spectrum_error", "spectrum error at the end, rms of ln(E/E_filtered)", "spectrum", SPECTRUM),
            ("acceleration_kl", "KL divergence of accelerations at the end", "accelerations", DIVERGENCE),
            ("qr_kl", "KL divergence of the Q–R plane at the end", "velocity gradients", DIVERGENCE)):
        error, floor = numbers[key], numbers[f"{key}_floor"]
        if None not in (error, floor):
            yield Judged(key, words, short, error, error, *(max(limit, times * floor) for limit, times in zip(
                limits, FLOORS)), f"truth itself: {floor:.2g}")


def _model(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    error, gradient = numbers.get("acceleration_error"), numbers.get("filtered_pressure_gradient_error")
    if error is not None:
        baseline, baseline_text = 1.0, "no model: 1"
        if gradient is not None and gradient < 1:
            baseline, baseline_text = gradient, f"the exact filtered pressure gradient alone: {gradient:.2g}"
        yield Judged("acceleration_error", "model: acceleration error at the true state",
                     "acceleration error at the true state", error, error,
                     *(limit * baseline for limit in BESIDE_GRADIENT), baseline_text)


def _kernel(numbers: Mapping[str, Any]) -> Iterator[Judged]:
    for field in ("velocity", "gradient"):
        baselines = {words: numbers[f"{key}_{field}_error"] for key, words in TEXTBOOK.items()
                     if numbers.get(f"{key}_{field}_error")}
        error = numbers.get(f"{field}_error")
        if error is not None and baselines:
            best = min(baselines, key=baselines.get)
            yield Judged(f"kernel_{field}_error", f"kernel: error of the {field} field", f"{field} error", error, error,
                         *(limit * baselines[best] for limit in BESIDE_TEXTBOOK), f"{best}: {baselines[best]:.2g}")
