"""Name the noise sources of an imager, and parse which of them are on."""

from __future__ import annotations

from dataclasses import dataclass, fields

from characterisation.files.errors import InputError, nearest


@dataclass(frozen=True)
class Noise:
    """Sources of noise that are on.

    ``shot`` of the signal, ``read``, ``row``, ``dark`` (shot noise of the dark current) and ``quantisation`` differ
    from image to image. ``dsnu``, ``prnu`` and ``column`` belong to the device. ``speckle`` belongs to the surface and
    the pose; it acts on the light (:mod:`mitsim.sensor.speckle`), not in the imager. With quantisation off, the
    converter is an ideal one of 16 bits: see
    :func:`mitsim.sensor.image_formation.converter`.
    """

    shot: bool = True
    read: bool = True
    row: bool = True
    dark: bool = True
    dsnu: bool = True
    prnu: bool = True
    column: bool = True
    speckle: bool = True
    quantisation: bool = True

    @classmethod
    def none(cls) -> Noise:
        """Return noise with all sources off."""
        return cls.only()

    @classmethod
    def only(cls, *names: str) -> Noise:
        """Return noise with these sources only."""
        sources = _sources(names, "noise")
        return cls(**{field.name: field.name in sources for field in fields(cls)})

    @classmethod
    def without(cls, *names: str) -> Noise:
        """Return noise with all sources but these."""
        return cls(**dict.fromkeys(_sources(names, "noise"), False))

    @classmethod
    def parse(cls, text: str, where: str = "--noise") -> Noise:
        """Parse noise as written on a command line.

        ``all``; ``none``; ``shot,read`` for these two and no other; ``no-shot,no-read`` for all but these two. Raises
        InputError for a name that is no source (it suggests the nearest), or if both forms are mixed.
        """
        words = [word.strip() for word in text.split(",") if word.strip()]
        if words in (["all"], ["none"]):
            return cls() if words == ["all"] else cls.none()
        removed = [word.removeprefix("no-") for word in words if word.startswith("no-")]
        if not words or (removed and len(removed) < len(words)):
            allowed = "all, none, sources to keep (shot,read) or sources to leave out (no-shot,no-read)"
            raise InputError(where, "", repr(text), allowed)
        names = _sources(removed or words, where)
        return cls.without(*names) if removed else cls.only(*names)

    @property
    def temporal(self) -> bool:
        """Return whether two images of the same light differ."""
        return self.shot or self.read or self.row or self.dark


def _sources(names: list[str] | tuple[str, ...], where: str) -> list[str]:
    sources = [field.name for field in fields(Noise)]
    for name in names:
        if name not in sources:
            raise InputError(where, "", repr(name), ", ".join(sources), nearest(name, sources))
    return list(names)
