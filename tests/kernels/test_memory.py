"""Memory that is freed and asked for again comes without new pages."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import resource
from eddies.kernels.memory import keep_freed_memory
{keep}
for round in range(20):
    block = b"1" * 2**24
    del block
    if round == 0:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(keep, **environment):
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    return int(subprocess.run([sys.executable, "-c", PROGRAM.format(keep=keep)], env=clean | environment, check=True,
                              capture_output=True, text=True, timeout=60).stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="another C library")
def test_freed_memory_is_used_again_unless_the_user_has_said_otherwise():
    kept = page_faults("keep_freed_memory()")
    assert kept < 100 < page_faults("pass", MALLOC_MMAP_THRESHOLD_="65536")
    assert page_faults("keep_freed_memory()", MALLOC_MMAP_THRESHOLD_="65536") > 100
