"""Numbers of the section on tracers."""

import numpy as np
import pytest

from eddies.analysis.tracer_statistics import EDGES, TracerStatistics
from eddies.report.tracers import section


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("viscosity, dissipation_rate", [(0.01, 0.5), (2.0, 30.0)])
def test_accelerations_are_in_units_of_kolmogorov(viscosity, dissipation_rate):
    """a_0 = 1 where a component of the acceleration has the rms (eps^3 / nu)^(1/4)."""
    some, acceleration_rms = np.arange(1.0, 3.0), (dissipation_rate**3 / viscosity) ** 0.25
    found = TracerStatistics(some, some, some, some, np.ones(EDGES.size - 1), 3.0, acceleration_rms, some, some, [])
    scales = {"viscosity": viscosity, "dissipation_rate": dissipation_rate, "reynolds_lambda": 60.0}
    assert section(found, scales, 0.0).numbers["acceleration_constant"] == pytest.approx(1)
    assert "follow the filtered flow" in section(found, scales, 0.0).text
    assert section(found, scales, 0.0, filtered=False).text == "Tracers follow the whole flow. It is not forced."
