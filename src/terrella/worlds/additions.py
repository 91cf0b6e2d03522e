"""Additions: how the pictures that an episode saw changed its place, as rows of an arena that its State points at."""

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import final

import torch

from ..core.arena import Arena
from ..core.state import State
from ..space.camera import Intrinsics
from ..space.fusing import fuse
from ..space.raster import Gaussians
from ..space.raster.gaussians import Y0, plain_sh

ROWS = "added_rows"  # the pointer into the arena; 0: the place as it was
TRUSTED = 20.0  # pixels in which a recorded Gaussian counts as seen before the episode
OBSERVED, INVENTED = 1, 0  # provenance of a Gaussian
Placed = Callable[[Gaussians, int], Gaussians]  # Gaussians and an entry -> with those of its things where these are now


@final
class Additions:
    """A place and its provenance uint8 [N], with room for `room` more Gaussians. A row of the arena holds colours, opacities,
    weights and provenance of all, and means and deviations of the added ones."""

    def __init__(self, place: Gaussians, provenance: torch.Tensor, room: int):
        self.place, self.provenance, self.room = place, provenance, room

    @cached_property
    def _arena(self) -> Arena:
        whole, number = (len(self.place) + self.room,), torch.float32
        parts = {
            "colours": (number, (*whole, 3)), "opacities": (number, whole), "weight": (number, whole),
            "known": (torch.uint8, whole), "means": (number, (self.room, 3)), "deviation": (number, (self.room,)),
        }  # fmt: skip
        return Arena(parts, room=8)

    @property
    def arenas(self) -> dict[str, Arena]:
        """To go with `empty` into a State."""
        return {ROWS: self._arena}

    def empty(self, batch: int) -> dict[str, torch.Tensor]:
        """State entries of episodes that saw nothing yet."""
        return {ROWS: torch.zeros(batch, dtype=torch.int64)}

    def of(self, state: State, entry: int) -> tuple[Gaussians, torch.Tensor]:
        """The place as one episode knows it, and the provenance of its Gaussians."""
        part = self._part(state, entry)
        return (self.place, self.provenance) if part is None else (self._whole(part), part["known"])

    def observed(
        self, state: State, rgb: torch.Tensor, depth: torch.Tensor, camera: Intrinsics, placed: Placed
    ) -> State:
        """`state`, whose episodes saw pictures uint8 [B, 3, H, W] with depth [B, H, W] from their poses."""
        state, kept, count = state.into(self.arenas), [], len(self.place)
        spare = torch.arange(count, count + self.room)
        for entry in range(state.batch):
            part = self._part(state, entry) or self._blank()
            known, pose = part["known"], state["pose"][entry]
            picture = rgb[entry].float() / 255, depth[entry], pose, camera
            after, weight, shown = fuse(placed(self._whole(part), entry), part["weight"], spare, *picture)
            kept.append({
                "colours": 0.5 + Y0 * after.sh[:, 0], "opacities": after.opacities, "weight": weight,
                "known": torch.where(shown, OBSERVED, known).to(torch.uint8),
                "means": after.means[count:], "deviation": after.scales[count:, 0],
            })  # fmt: skip
        rows = self._arena.keep({name: torch.stack([one[name] for one in kept]) for name in kept[0]})
        return state.replace(**{ROWS: rows})

    def _part(self, state: State, entry: int) -> dict[str, torch.Tensor] | None:
        row, arena = int(state[ROWS][entry]), state.arenas[ROWS]
        return {name: arena.read(name)[row] for name in arena.parts} if row else None

    def _blank(self) -> dict[str, torch.Tensor]:
        """The row of the unchanged place."""
        none = torch.zeros(self.room)
        trust = TRUSTED * (self.provenance == OBSERVED)
        return {
            "colours": torch.cat([0.5 + Y0 * self.place.sh[:, 0], none[:, None].expand(-1, 3)]),
            "opacities": torch.cat([self.place.opacities, none]), "weight": torch.cat([trust, none]),
            "known": torch.cat([self.provenance, none.to(torch.uint8)]),
            "means": none[:, None].expand(-1, 3), "deviation": none + 1e-3,
        }  # fmt: skip

    def _whole(self, part: Mapping[str, torch.Tensor]) -> Gaussians:
        """All Gaussians of a row: the place's own, then the added ones, which are round and of degree 0."""
        place, room = self.place, self.room
        round_ = torch.tensor([[1.0, 0, 0, 0]]).expand(room, 4)
        more = torch.cat([place.sh[:, 1:], place.sh.new_zeros(room, place.sh.shape[1] - 1, 3)])
        return Gaussians(
            torch.cat([place.means, part["means"]]), torch.cat([place.quats, round_]),
            torch.cat([place.scales, part["deviation"][:, None].expand(-1, 3)]), part["opacities"],
            torch.cat([plain_sh(part["colours"]), more], 1),
        )  # fmt: skip
