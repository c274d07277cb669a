"""Exact hidden stress, pressure and force of a filtered velocity of few modes, by plain Fourier transforms.

The package is not used. Fields are arrays (c, z, y, x) of a box of 2 pi, vectors in the order x, y, z.
"""

import numpy as np

CELLS = 24  # products of modes up to 5 are free of aliasing
_K = np.fft.fftfreq(CELLS, 1 / CELLS)
WAVE = np.stack(np.meshgrid(_K, _K, _K, indexing="ij")[::-1])
SQUARED = (WAVE**2).sum(0)
INVERSE = np.divide(1, SQUARED, out=np.zeros_like(SQUARED), where=SQUARED > 0)
HIGHEST_OF_PRODUCTS = 10


def modes_of(fields):
    return np.fft.fftn(fields, axes=(-3, -2, -1)) / CELLS**3


def fields_of(modes):
    return np.fft.ifftn(modes, axes=(-3, -2, -1)).real * CELLS**3


def random_velocity(seed, highest=3):
    """Solenoidal modes 0 < |k| <= highest of a random velocity; rms of a component 1."""
    modes = modes_of(np.random.default_rng(seed).standard_normal((3, *SQUARED.shape)))
    modes *= (SQUARED <= highest**2) & (SQUARED > 0)
    modes -= WAVE * (WAVE * modes).sum(0) * INVERSE
    return modes / np.sqrt((np.abs(modes) ** 2).sum() / 3)


class Filtered:
    """A velocity u of the given modes behind the Gaussian filter of width d: transfer exp(-k^2 d^2 / 24).

    velocity : modes of u_bar.
    stress : fields (3, 3, z, y, x) of tau_ij = filtered(u_i u_j) - u_bar_i u_bar_j, the hidden stress.
    pressure : modes of p_bar,  laplacian p_bar = -d_i d_j filtered(u_i u_j).
    hidden_pressure : modes of p_tau,  laplacian p_tau = -d_i d_j tau_ij.
    """

    def __init__(self, modes, width):
        transfer = np.exp(-SQUARED * width**2 / 24)
        self.velocity = transfer * modes
        u, u_bar = fields_of(modes), fields_of(self.velocity)
        products = transfer * modes_of(u[:, None] * u)
        self.stress = fields_of(products) - u_bar[:, None] * u_bar
        self.pressure = self._pressure_of(products)
        self.hidden_pressure = self._pressure_of(modes_of(self.stress))

    def force(self, viscosity=0.0, hidden=True):
        """Modes of -grad p_bar - div tau + nu laplacian u_bar: the acceleration of a particle that moves with u_bar; if
        not `hidden`, without tau and its pressure."""
        pressure = self.pressure if hidden else self.pressure - self.hidden_pressure
        force = -1j * WAVE * pressure - viscosity * SQUARED * self.velocity
        return force - self.stress_divergence() if hidden else force

    def stress_divergence(self):
        """Modes of div tau."""
        return (1j * WAVE * modes_of(self.stress)).sum(1)

    @staticmethod
    def _pressure_of(products):
        return -(WAVE[:, None] * WAVE * products).sum((0, 1)) * INVERSE


def at(modes, position):
    """Real fields of modes (c, kz, ky, kx) at positions (n, 3), summed up mode by mode: (n, c)."""
    k = np.arange(-HIGHEST_OF_PRODUCTS, HIGHEST_OF_PRODUCTS + 1)
    kept = modes[:, k][:, :, k][..., k]
    x, y, z = (np.exp(1j * np.outer(k, axis)) for axis in position.T)
    values = np.zeros((len(position), len(modes)))
    for component, each in enumerate(kept):
        along_x = np.tensordot(each, x, axes=(2, 0))  # (kz, ky, n)
        values[:, component] = np.einsum("zyn,yn,zn->n", along_x, y, z, optimize=True).real
    return values
