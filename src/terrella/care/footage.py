"""footage: where in the videos of a damaged recording each episode's pictures lie, and which of its rows they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..data.format import fill, where
from ..data.meta import Film
from ..data.storage.films import Reel, reel, whole_frames
from .features import BROKEN
from .film_checks import Shown, examine_films
from .pieces import Piece, short
from .survey import Survey


class Footage:
    """The videos of `cameras` for these pieces of rows. said: what was found; why: episode -> why rows are not shown."""

    def __init__(
        self, survey: Survey, cameras: Sequence[str], pieces: Sequence[Piece], said: list[str], why: dict[int, str]
    ):
        self.survey, self.cameras, self.said, self.why = survey, cameras, said, why
        self._reels: dict[str, Reel | None] = {}
        self.films = self._listed()
        lengths: dict[int, int] = {}
        for piece in pieces:
            lengths[piece.number] = max(lengths.get(piece.number, 0), piece.frame + piece.count)
        for camera in cameras:
            unknown = [number for number in lengths if (number, camera) not in self.films]
            self.films |= self._placed(camera, lengths, unknown) if unknown else {}

    def reel(self, file: str) -> Reel | None:
        """The packets of a video; None where it cannot be read."""
        if file not in self._reels:
            try:
                self._reels[file] = reel(self.survey.path(file), self.survey.fps)
            except BROKEN as error:
                self.said.append(f"{file} cannot be read ({short(error)})")
                self._reels[file] = None
        return self._reels[file]

    def shown(self, piece: Piece, strict: bool = False) -> np.ndarray:
        """bool [count]: rows that all cameras show; strict: every frame is decoded."""
        shown = np.ones(piece.count, bool)
        for camera in self.cameras:
            film = self.films.get((piece.number, camera))
            opened = self.reel(film.file) if film else None
            there = np.zeros(piece.count, bool)
            if film and opened:
                first = film.first + piece.frame
                there = np.isin(first + np.arange(piece.count), opened.frames[~opened.zeroed])
                if strict:
                    there &= whole_frames(self.survey.path(film.file), first, piece.count, self.survey.fps)
            if not there.all():
                self.why[piece.number] = f"{film.file if film else f'no video of {camera}'} shows no more"
            shown &= there
        return shown

    def _listed(self) -> dict[tuple[int, str], Film]:
        """(episode, camera) -> where its pictures lie: as meta/episodes says, but for videos that were exchanged."""
        listed = {
            (n, camera): film for n, episode in self.survey.episodes.items() for camera, film in episode.videos.items()
        }
        shown = Shown()
        for _ in examine_films(self.survey, shown, False):
            pass
        for key, (other, camera) in shown.exchanged.items():
            self.said.append(f"the video {listed[key].file} shows episode {other} ({camera}), and is put there")
        return {**listed, **{of: listed[key] for key, of in shown.exchanged.items()}}

    def _placed(self, camera: str, lengths: Mapping[int, int], unknown: list[int]) -> dict[tuple[int, str], Film]:
        """Of episodes that meta/episodes does not list: files of their own by their number, else one after another."""
        own = {n: fill(self.survey.video_path, video_key=camera, **where(n)) for n in lengths}
        files = [file for file in self.survey.films if f"/{camera}/" in f"/{file}"]
        if self.survey.ours or set(files) >= set(own.values()):
            return {(n, camera): Film(own[n], 0) for n in unknown if own[n] in files}
        placed, rest = {}, sorted(lengths)
        for file in files:
            opened = self.reel(file)
            room, first = (opened.count if opened else 0), 0
            while rest and first + lengths[rest[0]] <= room:
                placed[rest[0], camera] = Film(file, first)
                first += lengths[rest.pop(0)]
            if first != room:
                what = f"{first} of its {room} frames are of whole episodes, what follows cannot be told apart"
                self.said.append(f"{file}: {what}")
                break
        found = {(n, camera): placed[n, camera] for n in unknown if (n, camera) in placed}
        if found:
            self.said.append(f"{len(found)} episodes were found in the videos of {camera} by counting frames")
        return found
