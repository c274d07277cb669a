"""Products of a synthetic run: random smooth fields and particles in the layout of the stages."""

from functools import cache

import numpy as np

from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import create_product, write_table
from eddies.io.trajectories import TrajectoryWriter
from eddies.io.weights import save_weights
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.workflows.ground_truth.flow_run import write_spectra

LENGTH = 2 * np.pi
TURNOVER, START = 1.2, 0.6  # when the rollout starts, after the release of the tracers
WIDTH = np.pi / 4
SCALES = {
    "energy": 1.5, "dissipation_rate": 0.5, "injection_rate": 0.5, "total_energy": 1.6, "taylor_scale": 0.6,
    "reynolds_lambda": 45.0, "integral_scale": 1.1, "eddy_turnover_time": TURNOVER, "kmax_eta": 1.1,
    "mach_turbulent": 0.08, "density_rms": 0.004, "compressible_fraction": 1e-4, "skewness": -0.5,
    "flatness": 4.5, "velocity_rms": 1.0, "energy_x": 0.6, "energy_y": 0.5, "energy_z": 0.4,
    "kolmogorov_length": 0.05, "time_step": 0.05, "seconds_per_step": 0.04, "turnovers": 2.0,
}
COMPRESSIBLE = ("mach_turbulent", "density_rms", "compressible_fraction")


class RandomFlow:
    """A random solenoidal velocity with |k| <= 4 that decays, known at every point."""

    def __init__(self, seed: int, modes: int = 90) -> None:
        rng = np.random.default_rng(seed)
        self.k = rng.integers(-4, 5, size=(modes, 3)).astype(float)
        self.k = self.k[np.sum(self.k**2, axis=1) > 0]
        size = np.linalg.norm(self.k, axis=1)[:, None]
        amplitude = rng.normal(size=self.k.shape) * size ** (-11 / 6)
        self.amplitude = amplitude - self.k * np.sum(amplitude * self.k, axis=1, keepdims=True) / size**2
        self.phase = rng.uniform(0, LENGTH, len(self.k))
        self.amplitude *= 1 / np.sqrt(np.sum(self.amplitude**2) / 6)

    def _angle(self, position, time):
        return position @ self.k.T + self.phase + 0.8 * time * np.linalg.norm(self.k, axis=1)

    def velocity(self, position, time):
        return np.exp(-0.2 * time) * np.cos(self._angle(position, time)) @ self.amplitude

    def acceleration(self, position, time):
        interval = 1e-3
        return (self.velocity(position, time + interval) - self.velocity(position, time)) / interval

    @cache
    def field(self, cells, time):
        x = LENGTH * np.arange(cells) / cells
        z, y, x = np.meshgrid(x, x, x, indexing="ij")
        position = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        return self.velocity(position, time).T.reshape(3, cells, cells, cells)


flow_of = cache(RandomFlow)  # by seed


def provenance(*made_from, seed=1, forcing=""):
    return {"scene": f'title = "synthetic"\nseed = {seed}\n{forcing}', "fingerprint": "0" * 64, "made_from": made_from}


def write_ground_truth(comm, directory, tracers=True, cells=16, frames=0, stationary=False, density=True, seed=1,
                       forced=False, total=600):
    """Write ground_truth.h5. Its frames of tracers include the times of the rollout if `frames` is 13. A `stationary`
    flow has a span for averages. A flow without `density` is incompressible."""
    flow, origin = flow_of(seed), provenance(seed=seed, forcing='[forcing]\nwavenumber = 2.0\n' * stationary)
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", origin) as file:
        time = np.linspace(0, 4, 81)
        wiggle = 1 + 0.1 * np.sin(3 * time)
        scales = {name: value for name, value in SCALES.items() if density or name not in COMPRESSIBLE}
        columns = {name: value * wiggle for name, value in scales.items()} | {"turnovers": time / TURNOVER}
        write_table(file, "statistics", {"time": time, **columns})
        reference = {**scales, "energy_budget_error": 2e-4, "viscosity": 0.014, "kolmogorov_time": 0.17}
        series = FieldWriter(file, "filtered" if tracers else "final", cells, {"velocity": 3})
        series.append(0.0, 0, {"velocity": flow.field(cells, 0.0)})
        if tracers:
            reference |= {"released_at": 2.0, "filter_width": WIDTH, "spacing": LENGTH / total ** (1 / 3),
                          "acceleration_rms": 1.4, "density_mean": 1.0, "sound_speed": 20.0 if density else np.inf}
            reference |= {"density_rate_rms": 0.01} if density else {}
            write_spectra(file, "spectra", "time", decaying_spectra())
        if frames:
            write_tracers(file, frames, density, total)
        if forced:
            file.create_group("forcing").attrs.update({"injection_rate": 0.5, "wavenumber": 2.0})
        energy = np.outer(wiggle, decaying_spectra()["energy"][0])
        write_spectra(file, "spectra_of_statistics", "row", {"energy": energy})
        if stationary:
            file.create_group("stationary").attrs.update({"start": 1.0, "end": 3.0})
        file.create_group("reference").attrs.update(reference)


def write_tracers(file, frames, density, total):
    """Write frames of tracers, which are `particles` without an error."""
    shapes = {"position": (3,), "velocity": (3,)} | ({"density": ()} if density else {})
    writer = TrajectoryWriter(file, "tracers", total, LENGTH, shapes, np.float64, images=True)
    for step, time in enumerate(np.linspace(0, 1.2, frames)):
        writer.append(step, time, 0, particles(total, time - START))


@cache
def particles(total, time, growth=0.0):
    """All columns of particles that moved from random places with their present velocity, at a time since the start of
    the rollout. The velocity is that of the truth plus an error that grows linearly in time."""
    truth, error = flow_of(1), flow_of(4)
    start = np.random.default_rng(5).uniform(0, LENGTH, (total, 3))
    velocity = truth.velocity(start, time) + growth * time * error.velocity(start, time)
    acceleration = truth.acceleration(start, time) + growth * time * error.acceleration(start, time)
    return {"position": (start + time * velocity) % LENGTH, "velocity": velocity,
            "density": 1 + 0.01 * velocity[:, 0], "acceleration": acceleration}


def decaying_spectra():
    k, time = np.arange(28), np.linspace(0, 1.2, 7)
    shape = np.exp(-0.05 * k**1.5) * np.maximum(k, 1.0) ** (-5 / 3) * (k > 0)
    energy = np.exp(-0.4 * time)[:, None] * shape
    filtered = energy * np.exp(-k**2 * WIDTH**2 / 12)
    return {"time": time, "energy": energy, "filtered": filtered}


def write_kernel(comm, directory, seed=1):
    r, cells = np.linspace(0, 1, 101), 32
    shapes = {"learned": np.exp(-5 * r**2) * (1 - r) ** 2,
              "learned_no_gradient": np.exp(-9 * (r - 0.4) ** 2) * (1 - r),
              "cubic_spline": (1 - r) ** 3, "wendland": (1 - r) ** 4 * (1 + 4 * r)}
    kernels, slices, errors = {"r_over_h": r}, {}, {}
    plane = flow_of(2).field(cells, 0.0)[0, cells // 2]
    truth = {"velocity": plane, "gradient": np.gradient(plane, LENGTH / cells, axis=1)}
    slices |= {f"truth_{quantity}": values for quantity, values in truth.items()}
    for index, (name, shape) in enumerate(shapes.items()):
        kernels |= {f"value_{name}": 2 * shape, f"derivative_{name}": 2 * np.gradient(shape, r)}
        errors[f"integral_{name}"] = 1.0
        for quantity, values in truth.items():
            error = errors[f"{quantity}_error_{name}"] = 0.1 + 0.1 * index
            noise = np.random.default_rng(index).normal(size=values.shape)
            slices[f"{quantity}_{name}"] = values + error * values.std() * noise
    tables = {"kernels": kernels, "slices": slices, "errors": errors}
    network = KernelNetwork(1.4, [4], "smooth", seed)
    description = {"form": network.formula, "support": 1.4, "hidden": [4], "cutoff": "smooth"}
    weights = {name: tensor.numpy() for name, tensor in network.float().state_dict().items()}
    save_weights(comm, directory / "kernel.h5", "kernel", description, weights, provenance("ground_truth"), tables)


def write_model(comm, directory, terms=("pressure", "pairs"), source=None):
    """Write model.h5; `source` names another run from which its weights come."""
    rng = np.random.default_rng(3)
    step, delay = np.arange(0, 300, 10), np.linspace(-0.6, 0.6, 13)
    decay = np.exp(-step / 80)
    history = {name: scale * decay for name, scale in (
        ("loss", 1.0), ("trajectory_loss", 0.8), ("field_loss", 0.1), ("velocity_kl_loss", 0.01),
        ("acceleration_kl_loss", 0.02), ("learning_rate", 5e-3), ("gradient_norm", 2.0))}
    history |= {"step": step, "seconds": step * 0.02, "phase": 0 * step,
                "validation_error": np.where(step % 50 == 0, 0.25 + 0.7 * decay, np.nan)}
    a_priori = {"delay": delay, "acceleration_error": 0.24 + 0.03 * np.maximum(delay, 0),
                "true_density_acceleration_error": 0.22 + 0.02 * np.maximum(delay, 0),
                "pressure_gradient_error": 0.24 + 0 * delay}
    truth = rng.standard_t(5, size=(800, 3))
    predicted = 0.95 * truth + 0.2 * rng.normal(size=truth.shape)
    tables = {"history": history, "a_priori": a_priori,
              "acceleration_sample": {"truth": truth, "predicted": predicted}}
    if "density-flux" in terms:
        tables["a_priori"]["density_rate_error"] = 0.6 + 0.05 * delay
        tables["density_rate_sample"] = {"truth": truth[:, 0], "predicted": 0.8 * truth[:, 0]}
    origin = provenance("ground_truth", "kernel")
    if source:
        if "truths" not in source:
            tables["source_a_priori"] = {name: 0.9 * errors for name, errors in tables["a_priori"].items()}
        origin |= {"mach_turbulent": 0.16, "source": source}
    save_weights(comm, directory / "model.h5", "model", {"terms": {term: {} for term in terms}},
                 {"weight": np.ones(3)}, origin, tables)


def write_rollout(comm, directory, status="complete", total=600, frames=9, broken=None, injection_rate=0.0,
                  truth_injection_rate=0.0, density=True):
    """Write rollout.h5. The tracers of the truth end three frames earlier. Velocities of frame `broken` are NaN."""
    shapes = {"position": (3,), "velocity": (3,), "acceleration": (3,)} | ({"density": ()} if density else {})
    times = 0.1 * np.arange(frames)
    attributes = {"status": status, "start_time": START, "time_step": 0.02, "integrator": "verlet",
                  "method": "learned", "terms": "pressure, pairs", "turnovers": times[-1] / TURNOVER,
                  "seconds_per_step": 0.031, "particles": total, "ranks": 1, "eddy_turnover_time": TURNOVER,
                  "integrates_density": density, "injection_rate": injection_rate,
                  "truth_injection_rate": truth_injection_rate}
    origin = provenance("ground_truth", "kernel", "model")
    with create_product(comm, directory / "rollout.h5", "rollout", origin) as file:
        file.create_group("rollout").attrs.update(attributes)
        write_table(file, "outside_training", {"time": times, "share": 1e-3 * times * (0.9 - times)})
        late = times > 0
        write_table(file, "closure", {"time": times, "solves": 4.0 * late, "iterations": np.where(late, 10.0, 40.0),
                                      "most_iterations": np.where(late, 4.0, 40.0),
                                      "residual": np.full(len(times), 1e-3), "not_converged": 1.0 * ~late})
        writer = TrajectoryWriter(file, "model", total, LENGTH, shapes, np.float32, images=True)
        for step, time in enumerate(times):
            columns = particles(total, time, growth=0.4)
            if step == broken:
                columns = columns | {"velocity": np.full((total, 3), np.nan)}
            writer.append(step, time, 0, columns)


def write_run(comm, directory, truth=None, **rollout):
    """Write all four products; `truth` has arguments for the ground truth, the others are for the rollout."""
    directory.mkdir(parents=True, exist_ok=True)
    same = {name: rollout[name] for name in ("total", "density") if name in rollout}
    write_ground_truth(comm, directory, **{"frames": 13, **same, **(truth or {})})
    write_kernel(comm, directory)
    write_model(comm, directory)
    write_rollout(comm, directory, **rollout)
    (directory / "stage_seconds.json").write_text('{"dns": 12.5, "train-kernel": 3.0, "train": 7.0, "simulate": 4.0}')
