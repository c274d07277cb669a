"""An initial flow of one's own: Kida's flow of high symmetry, which decays into turbulence.

    python docs/examples/own_initial_flow.py        # or: mpirun -n 2 python docs/examples/own_initial_flow.py

runs the scene `tiny` from it, without forcing. A scene names it by its import path:

    [initial]
    kind = "own_initial_flow:kida"
    amplitude = 1.0
"""

import numpy as np

import eddies


def kida(grid, initial, seed: int) -> np.ndarray:
    """Fourier modes (3, kz, ky, kx) of the velocity (Kida 1985), solenoidal: u = sin x (cos 3y cos z - cos y cos 3z),
    and v, w with x, y, z exchanged in turn. `initial` holds the keys of [initial]: `amplitude` is the rms of a
    component here."""
    x, y, z = grid.coordinates()  # of this rank's points

    def component(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.sin(a) * (np.cos(3 * b) * np.cos(c) - np.cos(b) * np.cos(3 * c))

    velocity = np.stack([np.broadcast_to(part, grid.physical_shape)
                         for part in (component(x, y, z), component(y, z, x), component(z, x, y))])
    return grid.forward(2 * initial.amplitude * velocity.astype(grid.real))  # the rms of a component is 1/2


if __name__ == "__main__":
    eddies.run(eddies.load_scene("tiny", ['name="own-initial-flow"', "initial.kind=own_initial_flow:kida",
                                          "forcing.injection_rate=0.0"], removals=["variant"]))
