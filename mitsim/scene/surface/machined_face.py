"""Known properties of a machined metal face, and which of them contradict one another."""

from __future__ import annotations

from dataclasses import dataclass

from characterisation.files.errors import InputError
from mitsim.scene.surface.measured import HeightMap, Profile
from mitsim.scene.surface.processes import PROCESSES
from mitsim.scene.surface.scatter import Lay

#: properties that determine the lobe of a face; at most one may be given
INPUTS = ("height_map", "profile", "Rdq", "RSm", "gloss", "alpha", "alpha_u")

#: largest ratio of a given Ra to a measured Ra (or Sa): samples and cut-offs differ
RA_AGREES_WITHIN = 1.25


@dataclass(frozen=True)
class MachinedFace:
    """Known properties of a machined face; None if not given."""

    metal: str = "aluminium"
    process: str | None = None
    #: ``Ra``, ``Rq``, ``RSm`` [um]; ``Rdq`` [1]
    Ra: float | None = None
    Rq: float | None = None
    Rdq: float | None = None
    RSm: float | None = None
    #: ``profile`` across the lay and ``profile_along`` it
    profile: Profile | None = None
    profile_along: Profile | None = None
    height_map: HeightMap | None = None
    gloss: float | None = None  # [GU at 60 deg]
    #: ``alpha``, ``alpha_u``, ``alpha_v`` [1] in Beckmann's sense at the sensor's wavelength
    alpha: float | None = None
    alpha_u: float | None = None
    alpha_v: float | None = None
    lay: Lay | None = None  # direction of the marks
    nose_radius: float | None = None  # of the tool [mm]; ``feed_marks`` "blurred" or "resolved"
    feed_marks: str | None = None
    alpha_factor: float = 1.0  # a multiplier on alpha; ``wide_angle`` share
    wide_angle: float | None = None

    @property
    def process_or_default(self) -> str:
        """Return the process, by default ground."""
        return self.process or "ground"

    @property
    def said(self) -> list[str]:
        """Return the given properties that determine the lobe's width, other than Ra and process."""
        return [name for name in INPUTS if getattr(self, name) is not None]

    @property
    def lay_is_open(self) -> bool:
        """Return whether the process leaves marks whose direction is not given; a lay of "none" says there are none."""
        width_stated = self.lay is not None or self.alpha is not None or self.alpha_u is not None
        return not width_stated and PROCESSES[self.process_or_default].lay_ratio < 1

    @property
    def roughness(self) -> float:
        """Return Ra [um], measured if not given; NaN without either."""
        if self.Ra is not None:
            return self.Ra
        if self.profile is not None:
            return self.profile.Ra
        return self.height_map.Sa if self.height_map is not None else float("nan")


def check(face: MachinedFace, where: str) -> None:
    """Reject properties that contradict one another, do not suffice, or would be unused.

    Raises InputError naming both of two properties that exclude each other.
    """
    process_name = face.process_or_default
    process = PROCESSES[process_name]
    said = face.said
    for one, other in (("alpha_u", "alpha_v"), ("alpha_v", "alpha_u")):
        if getattr(face, one) is None and getattr(face, other) is not None:
            raise InputError(where, one, f"nothing, beside {other}", "both alpha_u and alpha_v, or neither")
    if len(said) > 1:
        hint = f"keep {said[0]}, the better source"
        raise InputError(where, said[1], f"{said[1]} beside {said[0]}", "one of them", hint)
    measured = face.profile.Ra if face.profile else face.height_map.Sa if face.height_map else None
    if face.Ra is None and measured is None:
        hint = "performance maps are looked up by Ra"
        raise InputError(where, "Ra", "nothing", "a number of um, or a profile or height_map to take it from", hint)
    if face.Ra is not None and measured is not None:
        source = "profile" if face.profile else "height_map"
        if not 1 / RA_AGREES_WITHIN <= face.Ra / measured <= RA_AGREES_WITHIN:
            allowed = f"the {measured:.3g} um of the {source}, within a factor {RA_AGREES_WITHIN:g}"
            hint = "check its unit, or leave Ra out"
            raise InputError(where, "Ra", f"{face.Ra:g} um beside a {source}", allowed, hint)
    if face.Rq is not None:
        if measured is not None:
            hint = "Rq is taken from the file"
            raise InputError(where, "Rq", "Rq beside a profile or height_map", "one of them", hint)
        if face.Ra is not None and not 1 <= face.Rq / face.Ra <= 2:
            raise InputError(where, "Rq", f"{face.Rq:g} um beside Ra {face.Ra:g} um", "1 to 2 times Ra")
    if face.profile_along is not None and (face.profile is None or face.lay not in ("u", "v")):
        raise InputError(where, "profile_along", "profile_along alone", "with profile and a lay of u or v")
    if face.lay in ("u", "v"):
        if face.alpha is not None or face.alpha_u is not None:
            name = "alpha" if face.alpha is not None else "alpha_u and alpha_v"
            hint = "alpha_u and alpha_v already give the directions"
            raise InputError(where, "lay", f"lay beside {name}", "one of them", hint)
        if process.lay_ratio == 1 and face.height_map is None and face.profile_along is None:
            raise InputError(where, "lay", f"a lay on a {process_name} face", "none: that process leaves no lay")
    if not process.feed_marks:
        for name in ("nose_radius", "feed_marks"):
            if getattr(face, name) is not None:
                key = "nose_radius_mm" if name == "nose_radius" else name
                raise InputError(where, key, f"{key} beside process {process_name}", "milled or turned faces only")
    elif face.Rq is not None:
        allowed = "none: the height between the feed marks is assumed from Ra"
        raise InputError(where, "Rq", f"Rq beside process {process_name}", allowed, "leave Rq out")
    elif face.feed_marks == "resolved" and face.alpha is None and face.alpha_u is None and said:
        allowed = "feed_marks blurred, or alpha of what lies between the marks"
        raise InputError(where, said[0], f"{said[0]} beside feed_marks resolved", allowed, "it includes the marks")
    elif face.nose_radius is not None and said:
        raise InputError(where, "nose_radius_mm", f"nose_radius_mm beside {said[0]}", "one of them")
