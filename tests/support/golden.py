"""Golden recordings: what the virtual vehicles record, kept in tests/golden, so that a test of a layer that only reads
recordings does not first simulate a vehicle for seconds.

    python tests/support/golden.py        record those that have no file yet

Values have the 32 bits of the frames in which sensors and drives send them. After a change of a virtual vehicle that is
meant to change what it records, delete the files and record them again; tests/service/test_golden.py compares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from upright.service.virtual.run import record
from upright.telemetry.arrow_file import write_parquet
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load

FOLDER = Path(__file__).parents[1] / "golden"


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a recording is made, with the arguments of `record`. `duration` in s; None for that of the experiment."""

    vehicle: str
    experiment: str
    hide: tuple[str, ...] = ()
    seed: int = 1
    duration: float | None = None

    @property
    def path(self) -> Path:
        seconds = [] if self.duration is None else [f"{self.duration:g}s"]
        return FOLDER / (
            "-".join([self.vehicle, self.experiment, *self.hide, f"seed{self.seed}", *seconds]) + ".parquet"
        )

    def simulated(self) -> Recording:
        """The recording as the virtual vehicle makes it now."""
        return record(self.vehicle, self.experiment, hide=self.hide, seed=self.seed, duration=self.duration)

    def write(self) -> None:
        """Records the virtual vehicle and replaces the file."""
        write_parquet(self.simulated(), self.path)
        table = pa.parquet.read_table(self.path)
        fields = [
            field.with_type(pa.float32()) if pa.types.is_floating(field.type) else field for field in table.schema
        ]
        numbers = [field.name for field in fields if pa.types.is_floating(field.type)]
        pa.parquet.write_table(
            table.cast(pa.schema(fields, metadata=table.schema.metadata)),
            self.path,
            compression="zstd",
            compression_level=19,
            use_dictionary=False,
            use_byte_stream_split=numbers,
            column_encoding={"timestamp_ns": "DELTA_BINARY_PACKED"},
        )


GOLDEN = (
    *(
        Recipe("monocab", "multisine", hide, 8, 15.0)
        for hide in (
            (),
            ("coulomb_friction",),
            ("viscous_friction",),
            ("viscous_friction", "input_gain"),
            ("viscous_friction", "periodic_disturbance"),
            ("input_delay=2.0",),
            ("sensor_delay=1.55",),
            ("torque_step=0.05",),
        )
    ),
    Recipe("monocab", "multisine", (), 1, 10.0),
    Recipe("monocab", "multisine", (), 5, 15.0),
    Recipe("monocab", "multisine", (), 11, 15.0),
    *(
        Recipe("monocab", "multisine", hide, 1, 30.0)
        for hide in (
            (),
            ("coulomb_friction=0.5",),
            ("coulomb_friction=0.0263@25",),
            ("viscous_friction=0.5@25",),
            ("periodic_disturbance=0.5",),
            ("periodic_disturbance=4@25",),
            ("torque_step=0.2@25",),
            ("disturbance=8,0.3", "viscous_friction=1@25"),
        )
    ),
    Recipe("monocab", "multisine", (), 2, 30.0),
    Recipe("monocab", "multisine", ("disturbance=8,0.3",), 11, 30.0),
    Recipe("monocab", "hold", (), 1, 30.0),
    *(Recipe("twsbr", "square", (), seed) for seed in (1, 2, 3, 4)),
    Recipe("twsbr", "square", ("disturbance",), 97),
    Recipe("twsbr", "square", (), 21, 8.0),
    Recipe("twsbr", "square", ("disturbance", "static_torque"), 83, 16.0),
    Recipe("cube", "multisine", (), 31, 10.0),
    Recipe("cube", "doublet", (), 31, 10.0),
)


@cache
def _known(recipe: Recipe) -> Recording:
    return load(recipe.path) if recipe in GOLDEN else recipe.simulated()


def recorded(
    vehicle: str, experiment: str, *, hide: Sequence[str] = (), seed: int = 1, duration: float | None = None
) -> Recording:
    """The golden recording that is made with these arguments of `record`; if there is none, it is simulated, once."""
    return _known(Recipe(vehicle, experiment, tuple(hide), seed, duration))


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for each in GOLDEN:
        if not each.path.exists():
            each.write()
            print(each.path.name, f"{each.path.stat().st_size / 1e3:.0f} kB")
