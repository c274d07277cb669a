"""Builds the compiled library, once for each instruction set; everything else of the package stands in setup.cfg."""

import copy
import hashlib
import platform
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CCompilerError, ExecError, PlatformError

KERNELS = Path("src/eddies/kernels")
# Many a Python asks for what a debugger needs, which takes a third of a compiler's time: -g0.
FLAGS = ["-std=c++17", "-O3", "-g0", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi", "-fopenmp"]
# Which sources the library is built from, as src/eddies/kernels/library.py tells them.
SOURCES = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(KERNELS.glob("*.?pp")))).hexdigest()
# As src/eddies/kernels/library.py has them.
INSTRUCTION_SETS = {"plain": []}
if platform.machine() in ("x86_64", "AMD64"):
    INSTRUCTION_SETS["avx2"] = ["-mavx2", "-mfma"]
    INSTRUCTION_SETS["avx512"] = ["-mavx2", "-mfma", "-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl"]


class BuildKernels(build_ext):
    """Builds shared objects that are loaded as plain libraries, so their names tell no version of Python."""

    def get_ext_filename(self, fullname: str) -> str:
        return fullname.replace(".", "/") + ".so"

    def finalize_options(self) -> None:
        super().finalize_options()
        self.parallel = True  # as many compilers as there are cores

    def build_extension(self, extension: Extension) -> None:
        # All instruction sets have object files of the same names, so each has a directory of its own.
        own = copy.copy(self)
        own.build_temp = str(Path(self.build_temp) / extension.name)
        build_ext.build_extension(own, extension)

    def run(self) -> None:
        try:
            super().run()
        except (CCompilerError, ExecError, OSError) as error:
            # Pip shows the end of what a build says: the last line is what to do.
            raise PlatformError(f"{error}\neddies needs a C++17 compiler with OpenMP for its kernels; CXX names one\n"
                                "install g++ (Debian, Ubuntu: apt-get install g++; Fedora, RHEL: dnf install gcc-c++; "
                                "conda: conda install gxx)") from None


setup(
    ext_modules=[Extension(f"eddies.kernels.{name}", sorted(map(str, KERNELS.glob("*.cpp"))),
                           depends=sorted(map(str, KERNELS.glob("*.hpp"))),
                           extra_compile_args=[*FLAGS, *more, f'-DEDDIES_SOURCES="{SOURCES}"'],
                           extra_link_args=["-fopenmp"], language="c++")
                 for name, more in INSTRUCTION_SETS.items()],
    cmdclass={"build_ext": BuildKernels},
)
