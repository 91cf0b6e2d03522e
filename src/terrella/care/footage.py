"""footage: finds the frames of each episode in the videos of a damaged recording, and the rows that they show."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..data.format import file_numbers, fill_template
from ..data.meta import Film
from ..data.storage.films import Packets, read_packets, whole_frames
from .features import BROKEN
from .film_checks import FilmFacts, examine_films
from .pieces import WholeRows, message_of
from .survey import Survey


class Footage:
    """The videos of `cameras` for these pieces of rows. notes: sentences for the report; why: episode -> why rows are lost."""

    def __init__(
        self, survey: Survey, cameras: Sequence[str], pieces: Sequence[WholeRows], notes: list[str], why: dict[int, str]
    ):
        self.survey, self.cameras, self.notes, self.why = survey, cameras, notes, why
        self._reels: dict[str, Packets | None] = {}
        self.films = self._listed()
        lengths: dict[int, int] = {}
        for piece in pieces:
            lengths[piece.number] = max(lengths.get(piece.number, 0), piece.frame + piece.count)
        for camera in cameras:
            unknown = [number for number in lengths if (number, camera) not in self.films]
            self.films |= self._placed(camera, lengths, unknown) if unknown else {}

    def read_packets(self, file: str) -> Packets | None:
        """The packets of a video; None where it cannot be read."""
        if file not in self._reels:
            try:
                self._reels[file] = read_packets(self.survey.path(file), self.survey.fps)
            except BROKEN as error:
                self.notes.append(f"{file} cannot be read ({message_of(error)})")
                self._reels[file] = None
        return self._reels[file]

    def shown(self, piece: WholeRows, strict: bool = False) -> np.ndarray:
        """bool [count]: the rows that all cameras show; `strict` decodes every frame."""
        shown = np.ones(piece.count, bool)
        for camera in self.cameras:
            film = self.films.get((piece.number, camera))
            opened = self.read_packets(film.file) if film else None
            visible = np.zeros(piece.count, bool)
            if film and opened:
                first = film.first + piece.frame
                visible = np.isin(first + np.arange(piece.count), opened.frames[~opened.zeroed])
                if strict:
                    visible &= whole_frames(self.survey.path(film.file), first, piece.count, self.survey.fps)
            if not visible.all():
                self.why[piece.number] = f"{film.file if film else f'no video of {camera}'} shows no more"
            shown &= visible
        return shown

    def _listed(self) -> dict[tuple[int, str], Film]:
        """(episode, camera) -> where its pictures lie, by meta/episodes, with exchanged videos put right."""
        listed = {
            (n, camera): film for n, episode in self.survey.episodes.items() for camera, film in episode.videos.items()
        }
        shown = FilmFacts()
        for _ in examine_films(self.survey, shown, False):
            pass
        for key, (other, camera) in shown.exchanged.items():
            self.notes.append(f"the video {listed[key].file} shows episode {other} ({camera}), and is moved there")
        return {**listed, **{of: listed[key] for key, of in shown.exchanged.items()}}

    def _placed(self, camera: str, lengths: Mapping[int, int], unknown: list[int]) -> dict[tuple[int, str], Film]:
        """Videos of episodes that meta/episodes does not list: files of their number, else one episode after another."""
        own = {n: fill_template(self.survey.video_path, video_key=camera, **file_numbers(n)) for n in lengths}
        files = [file for file in self.survey.films if f"/{camera}/" in f"/{file}"]
        if self.survey.ours or set(files) >= set(own.values()):
            return {(n, camera): Film(own[n], 0) for n in unknown if own[n] in files}
        placed, rest = {}, sorted(lengths)
        for file in files:
            opened = self.read_packets(file)
            room, first = (opened.count if opened else 0), 0
            while rest and first + lengths[rest[0]] <= room:
                placed[rest[0], camera] = Film(file, first)
                first += lengths[rest.pop(0)]
            if first != room:
                what = f"{first} of its {room} frames belong to whole episodes; the rest cannot be assigned"
                self.notes.append(f"{file}: {what}")
                break
        assigned = {(n, camera): placed[n, camera] for n in unknown if (n, camera) in placed}
        if assigned:
            self.notes.append(f"{len(assigned)} episodes were located in the videos of {camera} by counting frames")
        return assigned
