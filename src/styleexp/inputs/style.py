"""What is transferred: a mesh or a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes.mesh import Mesh

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class Style:
    """A style (Sec. 4.2): either ``mesh`` or ``picture`` is set, the other is None."""

    name: str
    """As the user gave it, a file's path included; for messages."""
    mesh: Mesh | None = None
    picture: Float[np.ndarray, "height width 3"] | None = None
    """float32 in [0, 1], row 0 at the top."""

    @classmethod
    def of(cls, content: Mesh | np.ndarray, name: str | None = None) -> Style:
        """The style with this mesh or picture; a mesh has a name of its own."""
        if isinstance(content, Mesh):
            return cls(name or content.name, mesh=content)
        return cls(name or "picture", picture=content)

    @property
    def repairs(self) -> tuple[str, ...]:
        """One sentence for each repair of the mesh."""
        return self.mesh.repairs if self.mesh is not None else ()
