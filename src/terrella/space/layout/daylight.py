"""Times of day: the sun, the light of the sky, and how bright a picture is to be."""

from dataclasses import dataclass

from ...core.errors import ContractError

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """A time of day. Brightness is relative to a white wall outdoors."""

    sun: tuple[float, float] | None  # heading and height above the horizon, degrees
    sunlight: Colour
    sky: Colour  # light of windows and open roofs
    exposure: float  # of the middle of a room
    zenith: str  # the sky's colours: high, low
    horizon: str
    lamps: float = 1.0  # brightness of lamps


TIMES = {
    "day": Daylight((215.0, 42.0), (14.0, 12.4, 9.8), (4.6, 5.0, 5.4), 0.36, "7fa9d6", "dfe9f0", 0.5),
    "noon": Daylight((200.0, 50.0), (17.0, 15.8, 13.6), (5.6, 6.0, 6.4), 0.38, "6fa1d8", "e4eef5", 0.3),
    "morning": Daylight((152.0, 24.0), (14.0, 11.0, 7.2), (3.6, 4.2, 5.0), 0.37, "8db4dc", "f6e6cf", 0.4),
    "sunset": Daylight((203.0, 9.0), (19.0, 8.2, 2.6), (2.1, 1.3, 1.05), 0.33, "5b74a8", "f7b26a", 0.35),
    "evening": Daylight(None, (0.0, 0.0, 0.0), (0.24, 0.34, 0.62), 0.17, "27406f", "c98f7c", 1.0),
    "night": Daylight(None, (0.0, 0.0, 0.0), (0.025, 0.04, 0.09), 0.13, "0a1226", "1d2b4a", 1.0),
    "overcast": Daylight(None, (0.0, 0.0, 0.0), (3.6, 3.9, 4.2), 0.32, "c3cbd2", "dde1e3", 0.5),
}
SAME_TIME = {"midday": "noon", "dawn": "morning", "sunrise": "morning", "sundown": "sunset", "dusk": "evening",
             "twilight": "evening", "midnight": "night", "cloudy": "overcast", "rainy": "overcast", "daytime": "day",
             "sunny": "day", "afternoon": "day", "nighttime": "night"}  # fmt: skip


def daylight_of(name: str) -> Daylight:
    """The time of day of a name; ContractError for others."""
    if name not in TIMES:
        raise ContractError(f"the time '{name:.40}' is none of {', '.join(TIMES)}.")
    return TIMES[name]
