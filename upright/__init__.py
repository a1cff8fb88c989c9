"""upright as a library: from a recording to the physical effect that a model lacks.

    import upright

    recording = upright.load("run.csv")
    print(upright.diagnose(recording, model="pendulum.toml"))

What `__all__` names is stable, by semantic versioning: it changes with the major version alone, and before 1.0 with the
minor one. The packages below (`upright.layers` says which) may change at any time. `import upright` imports nothing
else: each name is imported on its first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from upright.comparison import Comparison, compare
    from upright.diagnosis import Diagnosis, Finding, diagnose
    from upright.estimates import Value
    from upright.identification import Identification, identify
    from upright.layers.effects import Effect, EffectParameter, EffectState, Family, Place, Role, UprightError
    from upright.model import Model
    from upright.recording import Recording, RecordingWarning, load

    __version__: str

__all__ = [
    "Comparison",
    "Diagnosis",
    "Effect",
    "EffectParameter",
    "EffectState",
    "Family",
    "Finding",
    "Identification",
    "Model",
    "Place",
    "Recording",
    "RecordingWarning",
    "Role",
    "UprightError",
    "Value",
    "__version__",
    "compare",
    "diagnose",
    "identify",
    "load",
]

_HOMES = {
    "upright.comparison": ("Comparison", "compare"),
    "upright.diagnosis": ("Diagnosis", "Finding", "diagnose"),
    "upright.estimates": ("Value",),
    "upright.identification": ("Identification", "identify"),
    "upright.layers.effects": ("Effect", "EffectParameter", "EffectState", "Family", "Place", "Role", "UprightError"),
    "upright.model": ("Model",),
    "upright.recording": ("Recording", "RecordingWarning", "load"),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("upright")
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'upright' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
