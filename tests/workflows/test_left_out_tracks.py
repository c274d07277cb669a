"""Delaunay interpolation at left-out tracks. test_tracks.py compares all methods with measured tracks."""

import numpy as np
import pytest

from eddies.scene.scene import BOX_LENGTH
from eddies.workflows.left_out_tracks import interpolated

SPACING = BOX_LENGTH / 12


@pytest.fixture
def position():
    return BOX_LENGTH * np.random.default_rng(3).random((12**3, 3))


def test_a_linear_velocity_is_exact_within_the_tetrahedra_and_unknown_outside(position):
    slope = np.random.default_rng(4).standard_normal((3, 3))
    points = np.array([[1.0, 2.0, 3.0], [3.0, 3.0, 5.0], [-0.1, 3.0, 3.0]])
    found = interpolated({"position": position, "velocity": position @ slope}, points, 0.0)
    np.testing.assert_allclose(found[:2], points[:2] @ slope, atol=1e-12)
    assert np.isnan(found[2]).all()


def test_a_periodic_box_has_tetrahedra_across_its_faces(position):
    """At corners, edges and faces, where a box without images has no tetrahedra."""
    points = np.array([[0, 0, 0], [1e-3, 3, 0], [BOX_LENGTH - 1e-3, 1, 2]])
    known = {"position": position, "velocity": np.sin(position)}
    assert np.isnan(interpolated(known, points, 0.0)).all()
    # The error of linear interpolation is about the square of the spacing over eight, 0.03.
    np.testing.assert_allclose(interpolated(known, points, SPACING), np.sin(points), atol=0.1)


def test_particles_in_a_plane_span_no_volume(position):
    known = {"position": position * [1, 1, 0] + [0, 0, 3], "velocity": position}
    assert np.isnan(interpolated(known, position[:5], 0.0)).all()
