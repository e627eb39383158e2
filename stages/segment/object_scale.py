"""Metric scale from the measured size of an object, since photos alone have no scale."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from stages.core.errors import InputError

if TYPE_CHECKING:
    from stages.core.scene.scene import Scene

FORM = re.compile(r"object=(?P<object>[0-9]+)\s+(?P<side>height|length)=(?P<metres>[0-9.eE+-]+)")
OUTLIER_FRACTION = 0.005  # fraction of an object's Gaussians that is ignored at each end


@dataclass(frozen=True)
class ObjectScaleReference:
    """A measured length of an object: its height, or its longest extent along x, y or z."""

    object: int
    side: str  # height | length
    metres: float

    def applied(self, scene: Scene) -> Scene:
        """The scene with `metres_per_unit` from the object. Raises InputError if it is absent or has no extent."""
        means = scene.gaussians.means[scene.gaussians.object_id == self.object].double()
        if len(means) < 2:
            have = ", ".join(f"{o.id} ({o.name})" for o in scene.objects) or "none"
            raise InputError(f"--scale-reference: there is no object {self.object} in the scene; objects found: {have}")
        sides = means.quantile(1 - OUTLIER_FRACTION, dim=0) - means.quantile(OUTLIER_FRACTION, dim=0)
        units = float(sides[2] if self.side == "height" else sides.max())
        if units <= 0:
            raise InputError(
                f"--scale-reference: object {self.object} has no measurable {self.side} in the "
                "scene; name another object"
            )
        source = f"--scale-reference object={self.object} {self.side}={self.metres:g}"
        return replace(scene, scale={"metres_per_unit": self.metres / units, "source": source})


def parse_object_scale(text: str) -> ObjectScaleReference | None:
    """Parse a reference such as "object=1 height=0.12"; None for an empty text. Raises InputError for other forms."""
    if not text:
        return None
    found = FORM.fullmatch(text.strip())
    try:
        metres = float(found["metres"])
    except (TypeError, ValueError) as error:
        raise InputError(f'--scale-reference {text!r}: write "object=1 height=0.12" or "object=1 length=0.2", in '
                         "metres") from error  # fmt: skip
    if not 0 < metres < 1e5:
        raise InputError(f"--scale-reference {text!r}: the length must be more than 0 and less than 100,000 m")
    return ObjectScaleReference(int(found["object"]), found["side"], metres)
