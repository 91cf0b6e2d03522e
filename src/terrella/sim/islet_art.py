"""The art of Islet (sim/islet.py): its palette, sprites and island, painted once."""

from functools import cache
from typing import NamedTuple

import numpy as np

WIDTH, HEIGHT = 320, 240  # pixels of the whole map
_COLOURS = {
    "k": "2b2a3d", "N": "1f2748", "M": "48558a", "S": "4787b5", "s": "5d9fc7", "w": "8accd9", "f": "dcf2ec",
    "y": "eedca6", "Y": "d9bf85", "g": "8bc064", "l": "a2d076", "d": "6ea653", "t": "4c8d59", "T": "2f6651",
    "b": "ae7744", "B": "754a33", "r": "d4523f", "R": "9d3542", "o": "ef8d4b", "a": "f9d04f", "A": "fff4b8",
    "W": "fdfaf0", "G": "ccd1d0", "h": "949ca8", "H": "626879", "i": "f4a9c3", "I": "d8769f", "j": "fcd8e1",
    "v": "9b6fc6", "n": "f5c697", "u": "4569c9",
}  # fmt: skip
LETTERS = "." + "".join(_COLOURS)  # a letter's position is its palette index; 0 is transparent
PALETTE = np.array(
    [[0, 0, 0], *([int(one[at : at + 2], 16) for at in (0, 2, 4)] for one in _COLOURS.values())], np.uint8
)

# Sprites are side by side, separated by a blank column.
_WALKER = """
.rrrrrr. .rrrrrr. .rrrrrr. .rrrrrr. .rrrrrr. .rrrrrr. .rrrrr.. .rrrrr.. .rrrrr..
rrrrrrrr rrrrrrrr rrrrrrrr rrrrrrrr rrrrrrrr rrrrrrrr rrrrrrr. rrrrrrr. rrrrrrr.
RRRRRRRR RRRRRRRR RRRRRRRR rrrrrrrr rrrrrrrr rrrrrrrr RRRRRRRR RRRRRRRR RRRRRRRR
BnnnnnnB BnnnnnnB BnnnnnnB BRRRRRRB BRRRRRRB BRRRRRRB BBBnnnn. BBBnnnn. BBBnnnn.
BnknnknB BnknnknB BnknnknB BBBBBBBB BBBBBBBB BBBBBBBB BBnnnkn. BBnnnkn. BBnnnkn.
.nnnnnn. .nnnnnn. .nnnnnn. .BBBBBB. .BBBBBB. .BBBBBB. .Bnnnnn. .Bnnnnn. .Bnnnnn.
.aaaaaa. .aaaaaa. .aaaaaa. .aaaaaa. .aaaaaa. .aaaaaa. .aaaaa.. .aaaaa.. .aaaaa..
nuuuuuun nuuuuuun nuuuuuun nuuuuuun nuuuuuun nuuuuuun .uunuu.. .unuuu.. .uuuun..
.uuuuuu. .uuuuuu. .uuuuuu. .uuuuuu. .uuuuuu. .uuuuuu. .uuuuu.. .uuuuu.. .uuuuu..
.BB..BB. .BB..... .....BB. .BB..BB. .BB..... .....BB. ..BBB... .BB.BB.. ..BBB...
"""
_SMALL = """
.....o.o. .......o.o .......o.o ....WWW.. ..aa. .WWWWWW... .......... ...a... ..a.. i.i .i. ...........W.......... ...
.....ooo. o......ooo .......ooo ....WkWoo ..ako WWWWWWWHHH .WWWWWW... ...a... .aaa. iii .I. ..........WW.......... ...
.....oko. o......oko oo.....oko ....WWW.. aaaa. WWWWWWWHWH WWWWWWW... ..aAa.. aaAaa .I. .i. ..........WWW......... ...
.o...oooW .o.ooooooW ..oooooooW W..WWWW.. .aaa. WWWWWWWHHH WWWWWWWHHH aaAAAaa .aaa. i.i ... .........WWWW......... ...
o...ooooo .oooooooo. .oooooooo. WWWWWWWW. ..... WWWWWWW... WWWWWWWHWH .aAAAa. .a.a. ... ... .........WWWWi........ ...
o..ooooWW .oWWoooo.. .oWWoooo.. .WGGGWW.. ..... .GGGGGG... .GGGGGGHHH ..aaa.. ..... ... ... ........WWWWWii....... ...
.oooooWo. .o.o..o.o. ..oo..oo.. ..WWWWW.. ..... .H.H.H.H.. .H.H.H.H.. .aa.aa. ..... ... ... ........WWWWWiii...... ...
......... .......... .......... ......... ..... .......... .......... ....... ..... ... ... .......WWWWWWiiii..... ...
......... .......... .......... ......... ..... .......... .......... ....... ..... ... ... ...........b.......... ...
......... .......... .......... ......... ..... .......... .......... ....... ..... ... ... .bbbbbbbbbbbbbbbbbbbb. .WW
......... .......... .......... ......... ..... .......... .......... ....... ..... ... ... ..bBBBBBBBBBBBBBBBBb.. WWW
......... .......... .......... ......... ..... .......... .......... ....... ..... ... ... ...bbbbbbbbbbbbbbbb... WW.
"""
_PLANTS = """
.....t..... ....1111..... ................. ......... ...... ....... ...... ..........
.....t..... ..11111111... ....tt....ttt.... ......... ...... ....... ...... ..........
....ttt.... .1133111111.. ..tttttt.ttttttt. ......... ...... ....... ...... ..........
....ttT.... .1333111112.. .tt.tttttttT..TT. ......... ...... ....... ...... ..........
...ttttT... 113311111122. tt...ttttT....... ......... ...... ....... ...... ..........
..tttttTT.. 111111111122. ...ttttbtttt..... ......... ...... ....... ...... ..........
....ttT.... 111111111222. ..ttt..bb.tttt... ..1111... ...... ....... ..hhG. ..........
...ttttT... .11111112222. ..tt...bb...tt... .133111.. ...... ....... .hhGG. ..........
..ttttttT.. .12111122222. .......bB........ .1331112. ...... ..rrr.. .hhGGG ....r.....
.ttttttTTT. ..222222222.. ......bbB........ 111111122 ..hh.. .rWrrr. .hhGGG ....rr....
...tttTT... ....2bB22.... ......bB......... 111111222 .hGhH. rrrrWrR hhhGGG ..Y.B..Y..
..tttttTT.. .....bB...... .....bbB......... .2112222. hGhhHH rrWrrRR hhhGGh ..YyYyyY..
.ttttttTTT. .....bB...... .....bB.......... ..22222.. hhhhHH ..nWW.. hhhhGG ..yYYyYy..
tttttttTTTT ....bbBB..... ....bbB.......... ......... hhhHHH ..nWW.. hhhGGG Y.yyYYyy.Y
.....bB.... ............. ................. ......... .HHHH. ....... thhhGG YyyyBByyYy
.....bB.... ............. ................. ......... ...... ....... ttthhG yyyyBByyyy
"""
_BUILDINGS = """
........................ ................ .....rrr.... .......... ............... ...............
........................ .......rr....... ....rrrrR... .......... ............... ...............
................HHHH.... ......rrrR...... ...rrrrrRR.. .......... .......a....... ...............
................hhhH.... .....rrrrRR..... ...HHHHHHH.. .......... .....rraWW..... ...............
....rrrrrrrrrrrrhhhHr... ....rrrrrrRR.... ...HAAaAAH.. .......... ...rrrrWWWrr... ...............
...rrrrrrrrrrrrrhhhHrr.. ...rrrrrrrRRR... ...HAAaAAH.. .......... .rrrrWWWWrrrWW. ...............
...rRRrRRrRRrRRrhhhHrr.. ...BBBBBBBBBB... ...HAAaAAH.. ....rr.... rrrrrWWWrrrrWWW ...............
..rrrrrrrrrrrrrrrrrrrrr. ...WWWWWWWWGG... ..HHHHHHHHH. ...rrrR... RRR..WWb..rr..W ...............
..rrrrrrrrrrrrrrrrrrrrr. ...WWWWWWWWGG... ...WWWWWGG.. ..rrrrRR.. .......b....... ...............
.rRRrRRrRRrRRrRRrRRrRRrr ...WWWWuuWWGG... ...WWWWWGG.. .rrrrrrRR. .......b....... ...............
.rrrrrrrrrrrrrrrrrrrrrrr ..WWWWWuuWWWGG.. ...rrrrrRR.. RRRRRRRRRR .......b....... ...............
rrrrrrrrrrrrrrrrrrrrrrrr ..WWWWWWWWWWGG.. ...rrrrrRR.. .b......B. .......b....... ...............
RRRRRRRRRRRRRRRRRRRRRRRR ..WWWWWWWWWWGG.. ...rrrrrRR.. .b......B. .......b....... ...............
.WWWWWWWWWWWWWWWWWWWWGG. ..WWWWWWWWWWGG.. ..WWWWWWGGG. .b..hh..B. .......B....... ...............
.WWWWWWWWWWWWWWWWWWWWGG. ..WWWWWWWWWWGG.. ..WWWWWWGGG. .b..HH..B. .......B....... ...............
.WWBBBBBWWWWBBBBBBBWWGG. .WWWWWWWWWWWWGG. ..WWWWWWGGG. hhhhhhhhhH ............... .......b.......
.WWBwwwBWWWWBbbbbbBWWGG. .WWWWWWWWWWWWGG. ..WWuuWWGGG. hGhhGhhGHH ............... ......uub......
.WWBwuwBWWWWBbbbbbBWWGG. .WWWWBBBBWWWWGG. ..WWuuWWGGG. hhGhhGhhHH ............... .....suuuu.....
.WWBBBBBWWWWBbbbabBWWGG. .WWWWBbbBWWWWGG. .rrrrrrrRRR. .hhhhhhHH. ............... .....suuuu.....
.WWiIiIiWWWWBbbbbbBWWGG. .WWWWBbbBWWWWGG. .rrrrrrrRRR. .......... ............... ....ssuuuuu....
.WWWWWWWWWWWBbbbbbBWWGG. WWWWWBbaBWWWWWGG .rrrrrrrRRR. .......... ............... ....sskkuuu....
.GGGGGGGGGGGBbbbbbBGGGG. WWWWWBbbBWWWWWGG .rrrrrrrRRR. .......... ............... ...sskkkkuuu...
........................ GGGGGBbbBGGGGGGG WWWWWWWWGGGG .......... ............... ...sskkkkuuu...
........................ ................ WWWWBBBWGGGG .......... ............... ..sskkkkkkuuu..
........................ ................ WWWWBbBWGGGG .......... ............... ..sskkkkkkuuu..
........................ ................ GGGGBbBGGGGG .......... ............... .sssWkkkkWuuuu.
"""


def _cut(sheet: str, outline: str, swap: str = "") -> list[np.ndarray]:
    """The sprites of a sheet, palette indices [h, w], with an outline; `swap` has the colours of the digits."""
    for digit, letter in enumerate(swap, 1):
        sheet = sheet.replace(str(digit), letter)
    rows = sheet.strip("\n").split("\n")
    columns = np.array([list(row) for row in rows]).T
    ends = [-1, *np.flatnonzero((columns == " ").all(1)), len(columns)]
    sprites = []
    for left, right in zip(ends, ends[1:]):
        part = np.array([[max(LETTERS.find(one), 0) for one in row] for row in columns[left + 1 : right].T], np.uint8)
        full = np.flatnonzero(part.any(1))
        sprites.append(_outlined(part[full[0] : full[-1] + 1], outline))
    return sprites


def _outlined(part: np.ndarray, letter: str) -> np.ndarray:
    if not letter:
        return part
    part = np.pad(part, 1)
    near = np.zeros(part.shape, bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            near |= np.roll(part, shift, axis) > 0
    return np.where((part == 0) & near, LETTERS.index(letter), part).astype(np.uint8)


def _both(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Facing right, and facing left."""
    return part, part[:, ::-1]


class Art(NamedTuple):
    """The painted island."""

    ground: np.ndarray  # palette indices, uint8 [HEIGHT, WIDTH]
    base: np.ndarray  # int16 [HEIGHT, WIDTH], the row of the foot of the thing painted there (0: flat on the ground)
    blocked: np.ndarray  # bool [HEIGHT, WIDTH], not walkable
    sprites: dict[str, list]


# Positions of things: the middle of the foot, pixels of the map.
_FIRS = (
    "150,52 164,46 178,48 193,45 207,52 222,50 157,64 172,61 201,62 215,66 162,79 196,79 209,77 143,41 231,62 226,76"
)
_CHERRIES = "58,150 78,143 98,152 46,166 69,164 90,172 110,166 60,184 82,186 101,188 121,180"
_TREES = "38,96 50,86 122,44 118,142 202,150 230,172 244,96 286,118 274,128 214,100 92,124 264,102"
_PALMS = "214,202 233,205 266,190 274,176"
_BUSHES = "128,112 176,116 92,66 262,84 190,166 88,96 300,128 144,166 40,142 30,128"
_MENHIRS = "44,114 50,106 60,103 70,106 70,125 60,128 50,125"
_ROCKS = "124,208 302,116 36,160 296,158"
_SHROOMS = "184,82 151,79 219,82 190,60"
STARS = ((58, 116), (182, 60), (278, 82), (70, 176), (104, 180), (160, 200), (256, 192), (204, 124), (288, 146), (96, 52),
         (136, 100), (246, 164), (46, 136), (242, 76), (112, 160))  # fmt: skip
PEN = (100, 58, 142, 82)  # left, top, right, bottom of the sheep's fence
POND = (236, 128, 30, 16)  # middle and half axes
MILL, HUT = (72, 78), (152, 116)


class _Canvas:
    """The map during painting."""

    def __init__(self):
        self.ground = np.full((HEIGHT, WIDTH), LETTERS.index("S"), np.uint8)
        self.base = np.zeros((HEIGHT, WIDTH), np.int16)
        self.blocked = np.zeros((HEIGHT, WIDTH), bool)
        self.y, self.x = np.mgrid[:HEIGHT, :WIDTH]

    def fill(self, where: np.ndarray, letter: str) -> None:
        self.ground[where] = LETTERS.index(letter)

    def oval(self, x: float, y: float, across: float, down: float) -> np.ndarray:
        """Bool [HEIGHT, WIDTH]: inside an ellipse of half axes `across` and `down`."""
        return np.hypot((self.x - x) / across, (self.y - y) / down) < 1

    def stroke(self, curves: str, radius: float) -> np.ndarray:
        """Bool [HEIGHT, WIDTH]: near curves "x,y x,y x,y" (start, control point, end), separated by ";"."""
        where, size = np.zeros((HEIGHT, WIDTH), bool), int(radius) + 2
        row, column = np.mgrid[-size : size + 1, -size : size + 1]
        for curve in curves.split(";"):
            start, bend, end = _places(curve)
            for t in np.linspace(0, 1, 100):
                x, y = (a * (1 - t) ** 2 + 2 * b * t * (1 - t) + c * t**2 for a, b, c in zip(start, bend, end))
                left, top = int(x) - size, int(y) - size
                part = where[max(top, 0) : top + 2 * size + 1, max(left, 0) : left + 2 * size + 1]
                disc = np.hypot(column + int(x) - x, row + int(y) - y) < radius
                part |= disc[max(-top, 0) :, max(-left, 0) :][: part.shape[0], : part.shape[1]]
        return where

    def stand(self, sprite: np.ndarray, x: int, y: int, foot: tuple[int, int] = (0, 0), shade: int = 0) -> None:
        """Paints a sprite with the middle of its foot at (x, y) and blocks the foot, of half width and height `foot`."""
        high, wide = sprite.shape
        if shade:
            here = self.oval(x + 1, y, shade, shade * 0.45)
            self.fill(here & np.isin(self.ground, [LETTERS.index(one) for one in "gl"]), "d")
            self.fill(here & np.isin(self.ground, [LETTERS.index("y")]), "Y")
        place = np.s_[y - high + 1 : y + 1, x - wide // 2 : x - wide // 2 + wide]
        seen = (sprite > 0) & (self.base[place] <= y)
        self.ground[place][seen] = sprite[seen]
        self.base[place][seen] = y if foot[0] else 0
        if foot[0]:
            self.blocked[y - foot[1] + 1 : y + 1, x - foot[0] : x + foot[0]] = True


def _places(text: str) -> list[tuple[int, int]]:
    return [(int(x), int(y)) for x, y in (pair.split(",") for pair in text.split())]


@cache
def paint() -> Art:
    """The island and its sprites."""
    walker, small, plain = _cut(_WALKER, "k"), _cut(_SMALL, "k"), _cut(_SMALL, "")
    sprites = {
        "walker": [[_both(one) for one in walker[at : at + 3]] for at in (0, 3, 6)],  # front, back, side
        "cat": [_both(one) for one in small[:3]], "duck": _both(small[3]), "duckling": _both(small[4]),
        "sheep": [_both(one) for one in small[5:7]], "star": [small[7]], "lit": [plain[8]], "boat": _both(small[11]),
        "butterfly": plain[9:11], "puff": [plain[12]], "sails": [_sails(phase) for phase in range(4)],
    }  # fmt: skip
    canvas = _Canvas()
    _land(canvas)
    _water_and_paths(canvas)
    _gardens(canvas)
    _things(canvas)
    return Art(canvas.ground, canvas.base, canvas.blocked, sprites)


def _sails(phase: int) -> np.ndarray:
    """The four sails of the mill, rotated by `phase` quarters of a right angle."""
    y, x = np.mgrid[-13:14, -13:14]
    sprite = np.zeros((27, 27), np.uint8)
    for arm in range(4):
        angle = (arm + phase / 4) * np.pi / 2
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        sprite[(along > 4) & (along < 13) & (across > 0.5) & (across < 4)] = LETTERS.index("W")
        sprite[(along > 0) & (along < 13) & (np.abs(across) < 0.8)] = LETTERS.index("B")
    return sprite


def _land(canvas: _Canvas) -> None:
    """Sea, beach, grass."""
    x, y = canvas.x - 160, canvas.y - 122
    angle = np.arctan2(y / 96, x / 140)
    wobble = 1 + 0.045 * np.sin(3 * angle + 0.6) + 0.035 * np.sin(5 * angle + 2) + 0.02 * np.sin(9 * angle)
    inland = 105 * (1 - np.hypot(x / 140, y / 96) / wobble)  # approximate distance from the shore, pixels
    for column, row, radius in ((284, 70, 21), (284, 100, 24)):  # the lighthouse's cape
        inland = np.maximum(inland, radius - np.hypot(canvas.x - column, canvas.y - row))
    for least, letter in ((-15, "s"), (-7, "w"), (-2, "f"), (0, "Y"), (1.5, "y"), (9, "d"), (10.2, "g")):
        canvas.fill(inland > least, letter)
    canvas.blocked |= inland < 1.5
    beach = canvas.oval(258, 190, 44, 26) & (inland > 1.5)
    canvas.fill(canvas.oval(258, 190, 45, 27) & (inland > 9), "d")
    canvas.fill(beach, "y")
    waves = np.isin(canvas.ground, [LETTERS.index(one) for one in "Ss"]) & (inland < -10)
    for column, row in ((c, r) for r in range(4, HEIGHT, 11) for c in range(4 + 17 * (r % 2), WIDTH - 8, 34)):
        here = np.s_[row, column : column + 5]
        if waves[here].all():
            canvas.ground[here] = np.where(
                canvas.ground[here] == LETTERS.index("S"), LETTERS.index("s"), LETTERS.index("w")
            )
    meadow = canvas.ground == LETTERS.index("g")
    for x, y, across, down in (
        (70, 92, 34, 16),
        (150, 150, 30, 12),
        (250, 96, 26, 9),
        (206, 168, 20, 8),
        (118, 66, 30, 14),
    ):
        canvas.fill(meadow & canvas.oval(x, y, across, down), "l")


def _water_and_paths(canvas: _Canvas) -> None:
    """Pond, stream and paths."""
    x, y, across, down = POND
    stream = "254,136 280,138 276,150;276,150 272,166 318,164"
    bank = canvas.oval(x, y, across + 2, down + 2) | canvas.stroke(stream, 5.5)
    water = canvas.oval(x, y, across, down) | canvas.stroke(stream, 3.8)
    land = np.isin(canvas.ground, [LETTERS.index(one) for one in "gldyY"])
    canvas.fill(bank & land, "d")
    canvas.fill(water & land, "w")
    canvas.fill(canvas.oval(x, y + 1, across - 4, down - 4), "s")
    canvas.fill(water & land & ~np.roll(water, 2, 0), "b")
    canvas.fill(water & land & ~np.roll(water, 1, 0), "B")
    canvas.blocked |= water
    paths = (
        "158,118 158,130 160,140;160,140 110,134 72,84;160,140 196,142 200,112;200,112 210,84 280,80;160,140 160,168 160,198;"
        "160,140 110,152 84,166;88,108 72,116 60,115;200,122 202,168 252,184;178,138 172,96 182,58;210,150 234,158 266,148;"
        "286,147 294,126 286,84"
    )
    free = land & ~bank
    canvas.fill(canvas.stroke(paths, 4.6) & free & (canvas.ground != LETTERS.index("y")), "d")
    canvas.fill(canvas.stroke(paths, 3.6) & free, "Y")
    canvas.fill(canvas.stroke("160,136 160,138 160,140", 8) & free, "Y")
    canvas.ground[142:152, 264:288] = LETTERS.index("b")  # the bridge
    canvas.ground[142:152, 267:288:4] = canvas.ground[[142, 151], 264:288] = LETTERS.index("B")
    canvas.blocked[143:151, 264:288] = False
    for x, y in _places("214,134 219,138 252,119 256,136 224,117"):  # water lilies
        canvas.fill(canvas.oval(x, y, 3.2, 1.8), "t")
        canvas.ground[y - 1, x] = LETTERS.index("i")


def _gardens(canvas: _Canvas) -> None:
    """Tulips in rows, petals under the cherries, tufts and small flowers in the grass."""
    grass = np.isin(canvas.ground, [LETTERS.index(one) for one in "gl"])
    for x0, y0 in ((x, y) for y in range(12, HEIGHT - 12, 13) for x in range(12 + 11 * (y % 2), WIDTH - 12, 22)):
        x, y = x0 + (x0 * 7 + y0 * 5) % 9 - 4, y0 + (x0 * 3 + y0 * 11) % 7 - 3
        if not grass[y - 3 : y + 4, x - 3 : x + 4].all():
            continue
        kind = (x * 5 + y * 3) % 7
        if kind < 4:
            for column, row in ((-2, -1), (0, -1), (2, -1), (-1, 0), (1, 0)):
                canvas.ground[y + row, x + column] = LETTERS.index("d")
        else:
            for column, row in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                canvas.ground[y + row, x + column] = LETTERS.index("Wja"[kind - 4])
            canvas.ground[y, x] = LETTERS.index("aio"[kind - 4])
    for row, letter in zip(range(174, 204, 6), "raviW"):
        for x in (*range(133, 153, 5), *range(167, 191, 5)):
            place = np.s_[row - 1 : row + 4, x - 1 : x + 4]
            canvas.ground[place][grass[place]] = LETTERS.index("d")
        for x in (*range(133, 153, 5), *range(167, 191, 5)):
            if grass[row, x]:
                canvas.ground[row - 2 : row, x : x + 3] = LETTERS.index(letter)
                canvas.ground[row - 3, [x, x + 2]] = LETTERS.index(letter)
                canvas.ground[row : row + 2, x + 1] = LETTERS.index("T")
    for at, (x, y) in enumerate(_places(_CHERRIES)):
        for turn in range(9):
            column, row = x + round(13 * np.cos(turn * 2.4 + at)), y + round(7 * np.sin(turn * 2.4 + at)) + 2
            if grass[row, column]:
                canvas.ground[row, column] = LETTERS.index("j" if turn % 3 else "i")


def _things(canvas: _Canvas) -> None:
    """Trees, rocks, buildings and fences, from back to front."""
    fir, round_tree, palm, bush = _cut(_PLANTS, "T", "tTd")[:4]
    cherry, rock, mushroom, menhir, castle = (
        _cut(_PLANTS, outline, "iIj")[at] for outline, at in (("R", 1), ("k", 4), ("k", 5), ("k", 6), ("B", 7))
    )
    hut, mill, lighthouse, well, parasol, tent = _cut(_BUILDINGS, "k")
    left, top, right, bottom = PEN
    post, rail = np.full((7, 2), LETTERS.index("b"), np.uint8), np.full((6, 6), 0, np.uint8)
    rail[0], rail[3] = LETTERS.index("b"), LETTERS.index("B")
    things = [(hut, *HUT, (12, 9), 14), (mill, *MILL, (9, 7), 11), (lighthouse, 286, 74, (6, 5), 8),
              (well, 186, 130, (5, 4), 6), (parasol, 244, 190, (1, 2), 6), (castle, 222, 186, (6, 4), 0),
              (tent, 250, 74, (7, 5), 9)]  # fmt: skip
    for sprite, places, foot, shade in (
        (fir, _FIRS, (3, 3), 7), (cherry, _CHERRIES, (2, 3), 8), (round_tree, _TREES, (2, 3), 8), (palm, _PALMS, (2, 2), 6),
        (bush, _BUSHES, (5, 4), 6), (rock, _ROCKS, (3, 3), 5), (mushroom, _SHROOMS, (3, 3), 4), (menhir, _MENHIRS, (3, 3), 5),
    ):  # fmt: skip
        things += [(sprite, x, y, foot, shade) for x, y in _places(places)]
    for x in range(left, right + 1, 6):
        things += [
            (part, x + at, y, (3, 2), 0)
            for y in (top, bottom)
            for part, at in ((rail, 3), (post, 0))
            if x + at < right + 2
        ]
    things += [(post, x, y, (1, 2), 0) for x in (left, right) for y in range(top, bottom, 5)]
    canvas.blocked[top:bottom, left:right] = True
    for sprite, x, y, foot, shade in sorted(things, key=lambda one: one[2]):
        canvas.stand(sprite, x, y, foot, shade)
