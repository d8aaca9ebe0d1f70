// Possible measurements between faces, their nominal values, and their drawing as dimensions.

const add = (a, b, t = 1) => a.map((value, i) => value + t * b[i]);
const less = (a, b) => add(a, b, -1);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(...a);
const unit = (a) => a.map((value) => value / (length(a) || 1));
const DEGREES = 180 / Math.PI;

const along = (feature) => unit(feature.direction ?? [0, 0, 1]);
const lineAngle = (a, b) => Math.atan2(length(cross(a, b)), Math.abs(dot(a, b))) * DEGREES;
const sameWay = (a, b) => (dot(a, b) >= 0 ? b : b.map((value) => -value));
const onAxis = (point, normal, axis) => {
  const way = along(axis);
  return add(axis.point_mm, way, dot(less(point, axis.point_mm), normal) / dot(way, normal));
};

// Return the plane midway between two planes, with the normal in the sense of the first.
function midPlane(p, q) {
  const other = sameWay(along(p), along(q)), total = add(along(p), other), middle = add(p.point_mm, q.point_mm).map((v) => v / 2);
  const off = dot(less(middle, p.point_mm), along(p)) + dot(less(middle, q.point_mm), other);
  return { point_mm: add(middle, total, -off / dot(total, total)), direction: unit(total) };
}

// Return the geometry of a feature; a mid-plane has that of its two faces.
function geometry(name) {
  const one = features.get(name), [p, q] = (one?.of ?? []).map((parent) => features.get(parent));
  return one?.kind === 'mid_plane' && p?.point_mm && q?.point_mm ? { ...one, ...midPlane(p, q) } : one;
}

// Return the two ends of a distance [mm].
const ENDS = {
  plane_distance([p, q]) {
    const mean = unit(add(along(p), sameWay(along(p), along(q)))), middle = add(p.point_mm, q.point_mm).map((v) => v / 2);
    return [p, q].map((one) => add(middle, mean, dot(less(one.point_mm, middle), along(one)) / dot(mean, along(one))));
  },
  axis_distance([p, q]) {
    const mean = unit(add(along(p), sameWay(along(p), along(q)))), middle = add(p.point_mm, q.point_mm).map((v) => v / 2);
    return [p, q].map((one) => onAxis(middle, mean, one));
  },
  intersection_distance: ([plane, p, q]) => [p, q].map((one) => onAxis(plane.point_mm, along(plane), one)),
  point_distance: ([p, q]) => [p.point_mm, q.point_mm],
  point_plane_distance: ([p, plane]) => [p.point_mm, add(p.point_mm, along(plane), -dot(less(p.point_mm, plane.point_mm), along(plane)))],
};
const VALUES = {
  radius: ([one]) => one.radius_mm,
  diameter: ([one]) => 2 * one.radius_mm,
  cone_angle: ([one]) => 2 * one.half_angle_deg,
  plane_axis_angle: ([p, q]) => lineAngle(along(p), along(q)),
  axis_angle: ([p, q]) => lineAngle(along(p), along(q)),
  plane_angle: ([p, q]) => lineAngle(along(p), along(q)),
};

// Return the nominal value of a kind of measurement from the nominal geometry [mm, deg]; null if it needs more than faces.
function nominal(kind, named) {
  if (data.kinds[kind].zone) return 0;
  if (!named.every((one) => one?.point_mm)) return null;
  const value = ENDS[kind] ? length(less(...ENDS[kind](named))) : VALUES[kind]?.(named);
  return Number.isFinite(value) ? Math.round(value * 1e6) / 1e6 : null;
}

function orders(items) {
  if (items.length < 2) return [items];
  return items.flatMap((one, i) => orders(items.filter((_, j) => j !== i)).map((rest) => [one, ...rest]));
}

// Return the possible measurements of the chosen faces: [{kind, features in order}].
function possible(names) {
  if (!names.length || !names.every((name) => features.has(name))) return [];
  const kindOf = (name) => features.get(name).kind, found = [];
  for (const [kind, one] of Object.entries(data.kinds)) {
    const fits = (slots) => (order) => order.length === slots.length && order.every((name, i) => slots[i].includes(kindOf(name)));
    const order = one.many ? (names.length > 2 && names.every((name) => one.kinds[0].includes(kindOf(name))) ? names : null)
      : names.length > 4 ? null
        : orders(names).find(fits(one.kinds)) ?? (one.datums.length ? orders(names).find(fits([...one.kinds, ...one.datums])) : null);
    if (!order || (one.outline && KEYED.has(kindOf(order[0])) && !features.get(order[0]).outline_mm)) continue;
    const value = nominal(kind, order.map(geometry));
    if (value === null) continue;
    if (!suits(kind, order.map(geometry))) continue;
    found.push({ kind, features: order, nominal: value, unit: one.unit });
  }
  return found;
}

// Return whether a kind is meaningful for the angle between the faces; crossing planes have no distance.
function suits(kind, [p, q]) {
  if (kind === 'coaxiality') return lineAngle(along(p), along(q)) < 1 && length(cross(less(p.point_mm, q.point_mm), along(q))) < 1;
  if (!['plane_distance', 'axis_distance', 'parallelism', 'perpendicularity', 'angularity', 'symmetry'].includes(kind)) return true;
  const angle = lineAngle(along(p), along(q)), alike = FLAT.has(p.kind) === FLAT.has(q.kind);
  const parallel = alike ? angle : 90 - angle; // a plane is parallel to an axis perpendicular to its normal
  if (kind === 'symmetry') return parallel < 1 && Math.abs(dot(less(p.point_mm, q.point_mm), along(q))) < 1;
  return { plane_distance: angle < 1, axis_distance: angle < 45, parallelism: parallel < 1, perpendicularity: parallel > 89, angularity: parallel >= 1 && parallel <= 89 }[kind];
}

// Return the rim of a bore or a boss in a face that it meets at a right angle, as a feature; null if there is none.
function rim(names) {
  const named = names.map((name) => [name, features.get(name)]);
  const [plane, face] = named.find(([, one]) => one?.kind === 'plane') ?? [], [round, tube] = named.find(([, one]) => one?.kind === 'cylinder') ?? [];
  if (names.length !== 2 || !face || !tube || lineAngle(along(face), along(tube)) > 1) return null;
  const centre = onAxis(face.point_mm, along(face), tube).map((value) => Math.round(value * 1e4) / 1e4);
  const ends = (tube.outline_mm ?? []).map((one) => Math.abs(dot(less(one, centre), along(tube))));
  if (ends.length && Math.min(...ends) > 0.05 * tube.radius_mm + 0.05) return null; // it ends elsewhere
  const alike = (one) => one.kind === 'circle' && one.of[0] === plane && length(less(one.point_mm, centre)) < 1e-3;
  const there = [...features].find(([, one]) => alike(one))?.[0], base = cut(`${round}_rim`);
  const name = there ?? (features.has(base) ? cut(`${base}_${plane}`) : base);
  return { name, feature: { kind: 'circle', of: [plane], point_mm: centre, radius_mm: tube.radius_mm } };
}

// Return a name that the page and a task allow with a number after it: 80 characters, 100 bytes.
function cut(name) {
  const letters = [...name].slice(0, 76);
  while (new TextEncoder().encode(letters.join('')).length > 96) letters.pop();
  return letters.join('');
}

// Return the plane midway between two nearly parallel faces, of a slot or a rib, as a feature; null if there is none.
function midway(names) {
  const [p, q] = names.map((name) => features.get(name));
  if (names.length !== 2 || p?.kind !== 'plane' || q?.kind !== 'plane' || lineAngle(along(p), along(q)) > MOST_ASKEW) return null;
  const middle = midPlane(p, q), there = [...features].find(([, one]) => one.kind === 'mid_plane' && names.every((name) => one.of.includes(name)));
  const spread = (p.outline_mm ?? q.outline_mm)?.map((one) => add(one, middle.direction, -dot(less(one, middle.point_mm), middle.direction)).map((v) => Math.round(v * 1e4) / 1e4));
  const base = cut(`middle_of_${names.join('_and_')}`);
  let name = there?.[0] ?? base, n = 1;
  while (!there && features.has(name)) name = `${base}_${++n}`;
  return { name, feature: { kind: 'mid_plane', of: names, ...(spread ? { outline_mm: spread } : {}) } };
}

// Return the name of the measurement of the same kind and faces, if the task has one.
function already(kind, names) {
  const same = (one) => one.kind === kind && one.features.length === names.length && names.every((name) => one.features.includes(name));
  return [...measurements].find(([, one]) => same(one))?.[0];
}

// Return the points of a face's mesh [mm]; a mid-plane has those of its two faces.
function pointsOf(name) {
  const one = features.get(name), number = faces.findIndex((face) => face.name === name), used = new Set();
  if (one?.kind === 'mid_plane') return one.of.flatMap(pointsOf);
  owner.forEach((each, i) => { if (each === number) triangles.subarray(3 * i, 3 * i + 3).forEach((corner) => used.add(corner)); });
  return [...used].map((i) => [vertices[i], vertices[count + i], vertices[2 * count + i]]);
}

const extent = (points, way) => {
  let [low, high] = [Infinity, -Infinity];
  for (const point of points) {
    const at = point.reduce((sum, value, i) => sum + value * way[i], 0);
    [low, high] = [Math.min(low, at), Math.max(high, at)];
  }
  return high - low;
};

// Return the convex hull of points in a plane, by Andrew's monotone chain.
function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (list) => list.reduce((chain, p) => {
    const left = ([a, b]) => (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0;
    while (chain.length > 1 && !left(chain.slice(-2))) chain.pop();
    chain.push(p);
    return chain;
  }, []).slice(0, -1);
  return [...half(sorted), ...half(sorted.reverse())];
}

// Return the longer side of the smallest rectangle around a face, the diameter of a disk, or the length of an axis [mm].
function longerSide(name) {
  const one = geometry(name), points = pointsOf(name), way = along(one ?? {});
  if (!FLAT.has(one?.kind)) return extent(points, way);
  const first = unit(cross(way, Math.abs(way[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), second = cross(way, first);
  const corners = hull(points.map((point) => [dot(point, first), dot(point, second)]));
  const sides = corners.map((a, i) => {
    const b = corners[(i + 1) % corners.length], size = Math.hypot(b[0] - a[0], b[1] - a[1]), u = [(b[0] - a[0]) / size, (b[1] - a[1]) / size];
    return [extent(corners, u), extent(corners, [-u[1], u[0]])];
  });
  return Math.max(...sides.reduce((least, each) => (each[0] * each[1] < least[0] * least[1] ? each : least), [Infinity, Infinity]));
}

// Return the leg of a feature's angle with another [mm]: of a face its extent across their edge, of an axis its length.
function leg(name, other) {
  const one = geometry(name), way = along(one), across = add(along(geometry(other)), way, -dot(along(geometry(other)), way));
  return FLAT.has(one.kind) && length(across) > 0.02 ? extent(pointsOf(name), unit(across)) : longerSide(name);
}

// Return whether a cylinder is less than a bore or a boss, which span more than 200 deg, and whether it is convex.
function arc(name) {
  const one = geometry(name), number = faces.findIndex((face) => face.name === name), way = along(one), { normals } = view.solid;
  if (one.kind !== 'cylinder') return { part: false, convex: false };
  const first = unit(cross(way, Math.abs(way[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0])), second = cross(way, first);
  let outward = 0;
  const angles = [...new Set([...owner].flatMap((each, i) => (each === number ? [...triangles.subarray(3 * i, 3 * i + 3)] : [])))].map((i) => {
    const off = less([0, 1, 2].map((axis) => vertices[axis * count + i]), one.point_mm), x = dot(off, first), y = dot(off, second);
    outward += dot([0, 1, 2].map((axis) => normals[axis * count + i]), add(first.map((value) => x * value), second, y));
    return Math.atan2(y, x) * DEGREES;
  }).sort((a, b) => a - b);
  const gap = Math.max(...angles.map((angle, i) => (angles[i + 1] ?? angles[0] + 360) - angle));
  return { part: gap >= 160, convex: outward > 0 };
}

// Return the general tolerance of a measurement by the classes of a drawing's note, as ISO 2768; undefined without one.
function generalTolerance({ kind, nominal: value, features: names }, dimensions, zones) {
  // sizes of the mesh are rounded, so that a side of 100 mm is one of up to 100 mm
  const at = (table, name, size) => table?.[name]?.[table.to_mm.findIndex((end) => Math.round(size * 100) / 100 <= end)] ?? undefined;
  const { unit: of, zone } = data.kinds[kind], general = data.general;
  const shorter = () => Math.min(leg(names[0], names[1]), leg(names[1], names[0]));
  if (zone) return general.zones[kind] && at(general.zones[kind], zones, kind === 'perpendicularity' ? shorter() : Math.max(...names.map(longerSide)));
  if (of === 'deg') {
    const wide = names.length === 2 ? at(general.angles, dimensions, shorter()) : undefined;
    return wide && Math.round(wide / 60 * 1e4) / 1e4;
  }
  if (value < 0.5) return undefined; // to be given on the drawing
  const { part, convex } = kind === 'radius' ? arc(names[0]) : {};
  if (part) return at(convex ? general.broken_edges : general.linear, dimensions, value);
  const half = kind === 'radius' ? 2 : 1, wide = at(general.linear, dimensions, half * value); // half that of the diameter
  return wide === undefined ? undefined : wide / half;
}

const KEYED = new Set(['plane', 'cylinder', 'cone', 'mid_plane']);
const FLAT = new Set(['plane', 'mid_plane']);
const MOST_ASKEW = 5; // deg; a task takes planes whose normals have a sine of 0.1 or less

const short = (value) => String(Math.round(value * 1e4) / 1e4);

const MINUS = '\u2212';
const signed = (value) => (value < 0 ? `${MINUS}${short(-value)}` : `+${short(value)}`);

// Parse a tolerance: `0.1`, or both deviations as `+0.05 -0.1`; null if invalid, undefined if empty.
function readTolerance(text, zone) {
  const parts = text.replaceAll(MINUS, '-').replace('±', '').replaceAll(',', '.').split(/[\s/;]+/).filter(Boolean), numbers = parts.map(Number);
  if (!parts.length) return undefined;
  if (!numbers.every(Number.isFinite)) return null;
  if (numbers.length === 1) return numbers[0] > 0 ? numbers[0] : null;
  const [lower, upper] = [...numbers].sort((a, b) => a - b);
  return zone || numbers.length !== 2 || lower === upper ? null : [lower, upper];
}

const wrongTolerance = (text, zone) => `The tolerance ${text}: ${zone ? 'a number over 0' : 'a number over 0, or two deviations such as +0.05 -0.1'}, or empty`;
const toleranceText = (one) => (Array.isArray(one) ? `${signed(one[1])} ${signed(one[0])}` : one === undefined ? '' : short(one));

// Return the text of a dimension.
function dimensionText(one) {
  const zone = data.kinds[one.kind].zone, angle = one.unit === 'deg' ? '°' : '';
  if (zone) return [one.kind.replace('_', ' '), one.tolerance ? `${short(one.tolerance)}${angle}` : '', ...one.features.slice(1)].filter(Boolean).join(' | ');
  const sign = { radius: 'R', diameter: '⌀' }[one.kind] ?? '';
  return `${sign}${short(one.nominal)}${angle}${one.tolerance ? ` ${Array.isArray(one.tolerance) ? '' : '±'}${toleranceText(one.tolerance)}${angle}` : ''}`;
}

// Return a dimension as lines in mm, with the position of its text; null without a position.
function dimension(one) {
  const named = one.features.map(geometry), shown = one.features.map((name) => faces.find((face) => face.name === name));
  const anchors = shown.map((face) => face?.anchor).filter(Boolean);
  if (named.every((each) => each?.point_mm) && ENDS[one.kind]) {
    const ends = ENDS[one.kind](named), leaders = shown.flatMap((face, i) => (face?.anchor && shown.length === 2 ? [[face.anchor, ends[i]]] : []));
    return { lines: [ends], thin: leaders, arrows: true, at: add(ends[0], ends[1]).map((value) => value / 2) };
  }
  if (!anchors.length) return null;
  const [first] = anchors, feature = named[0];
  if ((one.kind === 'radius' || one.kind === 'diameter') && feature?.radius_mm) {
    const axis = feature.kind === 'cylinder' ? along(feature) : null;
    const centre = axis ? add(feature.point_mm, axis, dot(less(first, feature.point_mm), axis)) : feature.point_mm;
    const way = unit(less(first, centre)), end = add(centre, way, feature.radius_mm);
    const start = one.kind === 'diameter' ? add(centre, way, -feature.radius_mm) : centre;
    return { lines: [[start, end]], thin: [], arrows: true, at: add(end, way, 0.06 * view.reach) };
  }
  if (anchors.length > 1 && one.unit === 'deg') {
    const middle = add(anchors[0], anchors[1]).map((value) => value / 2), out = unit(less(middle, view.centre));
    const corner = add(middle, out, 0.12 * view.reach);
    return { lines: [], thin: [[corner, anchors[0]], [corner, anchors[1]]], arc: [corner, anchors[0], anchors[1]], at: corner };
  }
  const out = FLAT.has(feature?.kind) ? along(feature) : unit(less(first, view.centre));
  const at = add(first, out, 0.16 * view.reach);
  return { lines: [[at, first]], thin: [], arrows: 'end', at };
}
