"""upright as a library: from a recording to the physical effect that a model lacks.

    import upright

    recording = upright.load("run.csv")
    print(upright.diagnose(recording, model="pendulum.toml"))

What `__all__` names is stable, by semantic versioning: it changes with the major version alone, and before 1.0 with the
minor one. All packages of upright but this one may change at any time. `import upright` imports nothing else: each name
is imported on its first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from upright.library.comparison import Comparison, compare
    from upright.library.diagnosis import Diagnosis, Finding, diagnose
    from upright.library.estimates import Value
    from upright.library.identification import Identification, identify
    from upright.library.layers.effects import Effect, EffectParameter, EffectState, Family, Place, Role, UprightError
    from upright.library.model import Model
    from upright.library.recording import Recording, RecordingWarning, load

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
    "upright.library.comparison": ("Comparison", "compare"),
    "upright.library.diagnosis": ("Diagnosis", "Finding", "diagnose"),
    "upright.library.estimates": ("Value",),
    "upright.library.identification": ("Identification", "identify"),
    "upright.library.layers.effects": (
        "Effect",
        "EffectParameter",
        "EffectState",
        "Family",
        "Place",
        "Role",
        "UprightError",
    ),
    "upright.library.model": ("Model",),
    "upright.library.recording": ("Recording", "RecordingWarning", "load"),
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
