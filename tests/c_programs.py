"""Generated C in this process, and the diagram that it must agree with."""

import ctypes
import subprocess

import numpy as np

from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from system_doubles import Played

WARNINGS = ("-Wall", "-Wextra", "-Werror", "-pedantic", "-fmax-errors=3")
PORTS = ("state", "desired_preview", "features", "margins", "hold")
_OF_ASSESSOR = ("belief", "safety_probability", "cause_probability")


def build(compiler, *arguments, folder):
    """Compiles in a folder; warnings are errors."""
    done = subprocess.run(
        [compiler, *WARNINGS, *arguments], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[:2000]
    assert done.stderr == ""


class Library:
    """A generated source as a shared library; every structure is an array of numbers."""

    def __init__(self, source, info, detector, prefix="gamma"):
        build(
            *("gcc", "-std=c99", "-O3", "-fPIC", "-shared", source.name, "-lm", "-o", "gamma.so"),
            folder=source.parent,
        )
        self.functions = ctypes.CDLL(str(source.parent / "gamma.so"))
        self.prefix = prefix
        n_c, n_w = len(info.constraint_names), len(detector.watched)
        self.assessment = np.zeros(3 + 1 + 2 * n_c + 1 + 2 + 1 + 3 + 1)
        sizes = dict(alarm=1, levels=n_w, innovation=n_w, judged_share=1, cause=1)
        self._ends = np.cumsum([0, *sizes.values()])
        self._names = [*sizes]
        memory = 8 * n_w + 2 * len(detector.columns) + 8
        self.monitor = np.zeros(self._ends[-1] + memory)
        self._num_causes = n_c

    def assess(self, row, alarm):
        said = self.assessment
        function = self.functions[f"{self.prefix}_assess"]
        function(_pointer(row), ctypes.c_double(alarm), _pointer(said))
        n_c = self._num_causes
        ends = dict(zip(_OF_ASSESSOR, ((0, 3), (3, 4), (4, 4 + n_c)), strict=True))
        return {name: said[slice(*end)].copy() for name, end in ends.items()}

    def watch(self, row):
        self.functions[f"{self.prefix}_watch"](_pointer(row), _pointer(self.monitor))
        ends = zip(self._ends[:-1], self._ends[1:], strict=True)
        return {
            name: self.monitor[slice(*end)].copy()
            for name, end in zip(self._names, ends, strict=True)
        }

    def history(self, rows, stride):
        """Outputs after each row, of which every `stride`-th is assessed."""
        alarm, outputs = 0.0, []
        for k, row in enumerate(rows):
            if k % stride == 0:
                assessed = self.assess(row, alarm)
            outputs.append(assessed | self.watch(row))
            alarm = float(outputs[-1]["alarm"][0])
        return {name: np.array([one[name] for one in outputs]) for name in outputs[0]}


def _pointer(values):
    assert values.dtype == np.float64 and values.flags.c_contiguous
    return values.ctypes.data_as(ctypes.c_void_p)


def diagram_history(assessment, rows, widths):
    """The same of a `MonitoredSafetyAssessor`, and the text of the cause."""
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    inputs = dict(zip(PORTS, parts, strict=True))
    played = Played(MonitoredSafetyAssessor(assessment), assessment.detector_.step_s, **inputs)
    return played.history(*_OF_ASSESSOR, "alarm", "levels", "judged_share", "alarm_cause")
