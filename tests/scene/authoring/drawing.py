"""Dimensions and tolerances of the bracket, written into its STEP file as AP242 has them."""

from __future__ import annotations

import re


class Drawing:
    """Entities that are added to a STEP file whose faces are known by number."""

    def __init__(self, text: str) -> None:
        self.text, self.lines = text, []
        self.next = max(int(number) for number in re.findall(r"#(\d+)\s*=", text)) + 1
        self.shape = re.search(r"#(\d+)\s*=\s*PRODUCT_DEFINITION_SHAPE", text)[1]
        self.part = re.search(r"#(\d+)\s*=\s*ADVANCED_BREP_SHAPE_REPRESENTATION", text)[1]
        self.mm = self.add("( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.) )")
        metre = self.add("( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT($,.METRE.) )")
        tenth = self.add(f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(0.0254),#{metre})")
        none = self.add("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
        self.inch = self.add(f"( CONVERSION_BASED_UNIT('INCH',#{tenth}) LENGTH_UNIT() NAMED_UNIT(#{none}) )")
        self.radian = self.add("( NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.) )")

    def add(self, record: str) -> int:
        self.lines.append(f"#{self.next}={record};")
        self.next += 1
        return self.next - 1

    def aspect(self, *faces: int, kind: str = "SHAPE_ASPECT('',$,#{shape},.T.)") -> int:
        one = self.add(kind.format(shape=self.shape))
        for face in faces:
            self.add(f"GEOMETRIC_ITEM_SPECIFIC_USAGE('','',#{one},#{self.part},#{face})")
        return one

    def measure(self, value: float, name: str = "", unit: int | None = None, angle: bool = False) -> int:
        kind, of = ("PLANE_ANGLE_MEASURE", self.radian) if angle else ("LENGTH_MEASURE", unit or self.mm)
        return self.add(
            f"( {kind}_WITH_UNIT() MEASURE_REPRESENTATION_ITEM() MEASURE_WITH_UNIT({kind}({value!r}),#{of}) "
            f"REPRESENTATION_ITEM('{name}') )"
        )

    def values(self, dimension: int, *items: int) -> None:
        listed = ",".join(f"#{item}" for item in items)
        shown = self.add(f"SHAPE_DIMENSION_REPRESENTATION('',({listed}),$)")
        self.add(f"DIMENSIONAL_CHARACTERISTIC_REPRESENTATION(#{dimension},#{shown})")

    def size(self, name: str, *faces: int, items: tuple[int, ...]) -> int:
        made = self.add(f"DIMENSIONAL_SIZE(#{self.aspect(*faces)},'{name}')")
        self.values(made, *items)
        return made

    def plus_minus(self, dimension: int, low: int, high: int) -> None:
        self.add(f"PLUS_MINUS_TOLERANCE(#{self.add(f'TOLERANCE_VALUE(#{low},#{high})')},#{dimension})")

    def datum(self, letter: str, face: int) -> int:
        feature = self.aspect(face, kind="DATUM_FEATURE('',$,#{shape},.T.)")
        made = self.add(f"DATUM('',$,#{self.shape},.F.,'{letter}')")
        self.add(f"SHAPE_ASPECT_RELATIONSHIP('',$,#{feature},#{made})")
        return made

    def system(self, *datums: int) -> int:
        parts = [self.add(f"DATUM_REFERENCE_COMPARTMENT('',$,#{self.shape},.F.,#{one},$)") for one in datums]
        return self.add(f"DATUM_SYSTEM('',$,#{self.shape},.F.,({','.join(f'#{one}' for one in parts)}))")

    def tolerance(self, kind: str, zone: int, aspect: int, system: int | None = None, more: str = "") -> int:
        if system is None:
            return self.add(f"{kind}_TOLERANCE('',$,#{zone},#{aspect})")
        return self.add(
            f"( GEOMETRIC_TOLERANCE('',$,#{zone},#{aspect}) GEOMETRIC_TOLERANCE_WITH_DATUM_REFERENCE((#{system})) "
            f"{more} {kind}_TOLERANCE() )"
        )

    def whole(self) -> str:
        head, end, tail = self.text.partition("ENDSEC;\nEND-ISO")
        return head + "\n".join(self.lines) + "\n" + end + tail
