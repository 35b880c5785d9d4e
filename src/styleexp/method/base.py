"""The contract of a method: source and style in, the generated mesh out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from styleexp.inputs import meshes
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    import torch
    from jaxtyping import Float, Int

    from styleexp.method.subject import Subject


class Diverged(UserError):
    """A step, counted from 1, produced values the run cannot continue from."""

    def __init__(self, step: int, reason: str):
        self.step = step
        super().__init__(
            f"{reason} at step {step}: lower optim.rate, or check the source and the style for "
            "degenerate geometry."
        )


@dataclass(frozen=True)
class Scene:
    """What a method has prepared and no step changes. Methods with more to keep derive from it."""

    subject: Subject
    notes: tuple[str, ...] = ()
    """Notes for the user, besides the subject's."""

    @property
    def skips_blank_views(self) -> bool:
        """Whether views that don't show the mesh count for nothing."""
        return False


@dataclass
class State:
    """Everything a step changes; the content of a checkpoint.

    Restored are the module's ``state_dict``, the optimiser's tensors of each parameter, and the
    step. The optimiser's groups are those of `Method.start`: a rate that changes is set anew from
    ``step`` in every step.
    """

    field: Any
    """The module that is learned, such as a `fields.FourierMLP`."""
    optimizer: torch.optim.Optimizer
    step: int = 0


@dataclass(frozen=True)
class Step:
    """Measurements of one optimisation step."""

    step: int
    loss: float
    loss_global: float
    loss_local: float
    rms_displacement: float
    """RMS displacement, in radii of the normalised source."""
    blank_views: int
    """Number of views that don't show the mesh; a masked loss (``loss.masked``) skips them."""
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class Result:
    """The generated mesh M."""

    subject: Subject
    """The run's subject; its source has the result's faces."""
    displacement: Float[np.ndarray, " vertices"]
    """Signed displacement along the source's normals, in the source's own units."""
    vertices: Float[np.ndarray, "vertices 3"]
    """Positions in the source's own frame."""
    directions: Float[np.ndarray, "vertices 3"] | None = None
    """Unit tangent to the source at each vertex along which the pattern's up was laid, for a method
    that lays it (``direction.png``)."""

    @property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Indices of M's vertices, the source's faces."""
        return self.subject.source.faces

    def trimesh(self) -> Any:
        """M as a ``trimesh.Trimesh`` with the same vertex and face order; the displacement is the
        vertex attribute ``displacement``."""
        import trimesh

        return trimesh.Trimesh(
            self.vertices,
            self.faces,
            process=False,
            vertex_attributes={"displacement": self.displacement},
        )

    def save(self, path: str | Path) -> None:
        """Write M as PLY (with the displacement as a vertex attribute), OBJ, GLB, STL or 3MF."""
        meshes.save_mesh(self.subject.source, self.vertices, path, self.displacement)


def displaced(subject: Subject, displacement: Float[torch.Tensor, " vertices"]) -> Result:
    """M = C + d n (Eq. 1), in the source's own frame. ``displacement`` is in radii of the
    normalised source."""
    d = displacement.double().cpu()
    offset = (d[:, None] * subject.surface.normals.double().cpu()).numpy()
    radius = subject.frame.scale
    return Result(subject, d.numpy() * radius, subject.source.vertices + offset * radius)


S = TypeVar("S", bound=Scene)


class Method(ABC, Generic[S]):
    """A stylisation method: `prepare`, then `start`, every step of `optimise`, and `finish`.

    `testing.check_method` checks all of this. A method without steps has `finish` alone.
    """

    separates_relief: bool = False
    """Whether `Subject.example` is needed: a style mesh's relief apart from its shape."""

    def prepare(self, subject: Subject) -> S:
        """Measure and build what no step changes."""
        return Scene(subject)  # type: ignore[return-value]

    def start(self, scene: S) -> State | None:
        """State before the first step, whose tensors are checkpointed; None without steps."""
        return None

    def optimise(self, scene: S, state: State) -> Iterator[Any]:
        """Run the steps after ``state.step`` up to ``optim.steps``, yielding a dataclass after
        each. ``state.step`` is increased before; the state may be saved whenever one is yielded.

        The dataclass's fields form a line of ``metrics.jsonl``: ``step``, counted from 1, ``loss``
        and ``seconds`` are required, and displayed. Draw random numbers from
        `views.step_generator`, so that resumed runs are reproducible.
        """
        return iter(())

    @abstractmethod
    def finish(self, scene: S, state: State | None) -> Result:
        """The generated mesh, its displacement multiplied by ``settings.strength``. It equals the
        source bit for bit where ``subject.mask`` is 0, or everywhere with no strength. If its faces
        differ from the source's, the result's subject has a source with these faces, in the same
        frame."""
