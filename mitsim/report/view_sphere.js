// The sphere of views: choice, order, colours and drawing.

const place = (name) => document.getElementById(`sphere-${name}`);
const data = JSON.parse(place('data').textContent);
const { views, box } = data;
const panel = new Panel(data);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const along = (start, direction, length) => start.map((value, axis) => value + length * direction[axis]);

// Quantities for colouring views; `good` is the bright end.
const QUANTITIES = {
  uncertainty: {
    told: 'predicted standard uncertainty', logarithmic: true, good: 'small',
    of: (m, i) => m.uncertainty[i], text: (m, v) => quantity(v, m.unit), unit: (m) => (m.unit === 'deg' ? '°' : m.unit),
  },
  score: { told: 'view score Vₘ', good: 'large', of: (m, i) => m.score[i], text: (m, v) => rounded(v, 2), unit: () => '1' },
  chance: { told: 'chance of enough points', good: 'large', of: (m, i) => m.chance[i], text: (m, v) => percent(v), unit: () => '1' },
  points: {
    told: 'expected points on the limiting feature', logarithmic: true, good: 'large', text: (m, v) => counted(v), unit: () => '1',
    of: (m, i) => (data.features.find(({ name }) => name === m.limiting[i]) ?? fewest(m, i))?.points[i] ?? 0,
  },
};

const fewest = (m, i) => m.features.map((f) => data.features[f]).sort((p, q) => p.points[i] - q.points[i])[0];
const sites = []; // the views of each direction
views.site.forEach((site, i) => (sites[site] ??= []).push(i));
const state = { measurement: data.measurements[0], quantity: 'uncertainty', chosen: 0, paint: 'noise', set: null };

// ---- order and colours

const can = (i) => (state.quantity === 'score' ? state.measurement.possible[i] : state.measurement.able[i]) === 1;

function rank() {
  const m = state.measurement, { of, good } = QUANTITIES[state.quantity], sign = good === 'small' ? 1 : -1;
  const ahead = (i, j) => (state.quantity === 'uncertainty' ? 0 : sign * (of(m, i) - of(m, j))) || m.rank[i] - m.rank[j];
  state.order = views.number.map((_, i) => i).filter(can).sort(ahead);
  const first = new Map(state.order.map((i, position) => [i, position]));
  state.shown = sites.map((those) => those.reduce((i, j) => ((first.get(j) ?? Infinity) < (first.get(i) ?? Infinity) ? j : i)));
  Object.assign(state, ends(state.order.map((i) => of(m, i)).filter((value) => known(value) && value > 0)
    .sort((a, b) => sign * (a - b))));
}

// Return the ends of the colour scale for values from the best to the worst. On a logarithmic scale the worst tenth shares
// the end colour; otherwise a few very bad views would leave one colour to all others.
function ends(values) {
  const { logarithmic, good } = QUANTITIES[state.quantity];
  if (!values.length) return { low: 0.1, high: 1, more: false };
  if (!logarithmic) return { low: 0, high: state.quantity === 'chance' ? 1 : Math.max(...values), more: false };
  const [best, bad] = [values[0], values[Math.ceil(0.9 * (values.length - 1))]];
  const [low, high] = good === 'small' ? [best, bad] : [bad, best];
  return high > low ? { low, high, more: bad !== values.at(-1) } : { low: low / 1.2, high: low * 1.2, more: false };
}

// Return the position of a value between bad (0) and good (1).
function goodness(value) {
  const { logarithmic, good } = QUANTITIES[state.quantity], { low, high } = state;
  const share = logarithmic ? Math.log(Math.max(value, 1e-12) / low) / Math.log(high / low) : (value - low) / (high - low);
  return Math.min(Math.max(good === 'small' ? 1 - share : share, 0), 1);
}

function between(stops, share) {
  const at = share * (stops.length - 1), i = Math.min(Math.floor(at), stops.length - 2), t = at - i;
  const part = (colour, from) => parseInt(colour.slice(from, from + 2), 16);
  const mix = [1, 3, 5].map((from) => Math.round((1 - t) * part(stops[i], from) + t * part(stops[i + 1], from)));
  return `#${mix.map((value) => value.toString(16).padStart(2, '0')).join('')}`;
}

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// ---- the two pictures

const solid = data.part && {
  vertices: places(new Uint16Array(bytes(data.part.vertices).buffer), box),
  normals: new Int8Array(bytes(data.part.normals).buffer),
  triangles: new Uint16Array(bytes(data.part.triangles).buffer),
};
const clouds = new Map(); // decoded when first shown

function cloud(number) {
  if (!clouds.has(number)) {
    const raw = bytes(place(`cloud-${number}`).textContent), count = raw.length / 8;
    clouds.set(number, {
      places: places(new Uint16Array(raw.buffer, 0, 3 * count), box),
      noise: raw.subarray(6 * count, 7 * count), feature: raw.subarray(7 * count),
    });
  }
  return clouds.get(number);
}

const numbers = Object.keys(data.clouds).map(Number);
const everything = solid?.vertices ?? (numbers.length ? cloud(numbers[0]).places : new Float32Array(3));

function extent(centre) {
  const count = everything.length / 3;
  let reach = 0;
  for (let i = 0; i < count; i++) {
    reach = Math.max(reach, Math.hypot(...centre.map((value, axis) => everything[axis * count + i] - value)));
  }
  return reach || 1;
}

const middle = [0, 1, 2].map((axis) => {
  const plane = everything.subarray((axis * everything.length) / 3, ((axis + 1) * everything.length) / 3);
  return (plane.reduce((a, b) => Math.min(a, b), Infinity) + plane.reduce((a, b) => Math.max(a, b), -Infinity)) / 2;
});
const centre = solid || numbers.length ? data.target : [0, 0, 0];
const radius = 1.9 * extent(centre);
// a partial sphere is viewed at the middle of its part
const heights = views.direction.map((direction) => direction[2]);
const lift = (Math.max(0, ...heights) + Math.min(0, ...heights)) / 2;
const sphere = new Scene(place('canvas'), { centre: along(centre, [0, 0, 1], 0.8 * lift * radius), reach: 1.04 * radius, solid, marks: drawViews });
const seen = new Scene(place('seen'), { centre: middle, reach: 1.05 * extent(middle), solid, marks: drawNames });
const nearest = sites.map((those, s) => Math.min(...sites.map((others, t) => (s === t ? 9 : separation(those[0], others[0])))));
const spacing = [...nearest].sort((a, b) => a - b)[Math.floor(nearest.length / 2)] ?? 0.3;

function separation(i, j) {
  return Math.acos(Math.min(Math.max(dot(views.direction[i], views.direction[j]), -1), 1));
}

function drawViews(context) {
  const ink = style('--ink'), muted = style('--muted'), paper = style('--paper'), best = state.order[0];
  const m = state.measurement, back = sphere.rows[2], marked = [];
  drawGlobe(context, muted, ink);
  const size = Math.min(Math.max(0.36 * spacing * (radius / sphere.reach) * sphere.scale, 4), 12);
  for (const those of sites) {
    const i = those.includes(state.chosen) ? state.chosen : state.shown[views.site[those[0]]];
    const [x, y, key] = sphere.project(along(centre, views.direction[i], radius));
    if (!sphere.hides(x, y, key)) marked.push({ view: views.number[i], i, x, y, key, near: dot(views.direction[i], back) });
  }
  marked.sort((a, b) => a.key - b.key);
  sphere.canvas.places = marked; // in CSS pixels, for the pointer and for tests
  for (const { i, x, y, near } of marked) {
    const r = size * (near < 0 ? 0.65 : 1); // marks on the far side are smaller
    context.globalAlpha = near < 0 ? 0.5 : 1;
    context.beginPath();
    context.arc(x, y, can(i) ? r : 0.8 * r, 0, 2 * Math.PI);
    context.fillStyle = can(i) ? between(data.palette.views, goodness(QUANTITIES[state.quantity].of(m, i))) : style('--field');
    context.fill();
    context.lineWidth = 1;
    context.strokeStyle = can(i) ? ink : muted;
    context.stroke();
    if (!can(i)) cross(context, x, y, 0.42 * r, ink);
    context.globalAlpha = 1;
    const every = sites[views.site[i]];
    if (every.some((k) => data.checked.includes(views.number[k]))) outline(context, x, y, 1.5 * r, 4, ink, paper);
    if (state.set && every.some((k) => state.set.views.includes(views.number[k]))) outline(context, x, y, 1.75 * r, 0, ink, paper);
    if (every.includes(best)) ring(context, x, y, r + 5, 3, style('--best'), paper);
    if (i === state.chosen) {
      ring(context, x, y, r + (every.includes(best) ? 9 : 4), 2.5, ink, paper);
      drawSensor(context, i, ink);
    }
  }
}

function ring(context, x, y, r, width, colour, halo) {
  for (const [line, stroke] of [[width + 2, halo], [width, colour]]) {
    context.beginPath();
    context.arc(x, y, r, 0, 2 * Math.PI);
    Object.assign(context, { lineWidth: line, strokeStyle: stroke });
    context.stroke();
  }
}

// Draw a diamond (a rotated square) or a square.
function outline(context, x, y, r, turned, colour, halo) {
  const corners = [0, 1, 2, 3].map((k) => ((2 * k + (turned ? 0 : 1)) * Math.PI) / 4);
  for (const [line, stroke] of [[3.5, halo], [1.6, colour]]) {
    context.beginPath();
    corners.forEach((angle) => context.lineTo(x + r * Math.cos(angle), y + r * Math.sin(angle)));
    context.closePath();
    Object.assign(context, { lineWidth: line, strokeStyle: stroke });
    context.stroke();
  }
}

function cross(context, x, y, r, colour) {
  context.beginPath();
  for (const side of [-1, 1]) {
    context.moveTo(x - r, y - side * r);
    context.lineTo(x + r, y + side * r);
  }
  Object.assign(context, { lineWidth: 1.5, strokeStyle: colour });
  context.stroke();
}

// Draw a line through places where the part does not occlude it.
function path(context, line, colour, width) {
  Object.assign(context, { strokeStyle: colour, lineWidth: width });
  context.beginPath();
  let drawing = false;
  for (const one of line) {
    const [x, y, key] = sphere.project(one), open = !sphere.hides(x, y, key);
    if (open && drawing) context.lineTo(x, y);
    else if (open) context.moveTo(x, y);
    drawing = open;
  }
  context.stroke();
}

const font = (size) => `${size}px system-ui, sans-serif`;

function write(context, text, x, y, colour, halo, size = 12) {
  Object.assign(context, { font: font(size), textAlign: 'center', textBaseline: 'middle', lineJoin: 'round' });
  Object.assign(context, { lineWidth: 4, strokeStyle: halo, fillStyle: colour });
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}

// Draw rings of elevation down to the lowest views, and the part's axes.
function drawGlobe(context, muted, ink) {
  const lowest = Math.min(...views.elevation_deg), paper = style('--paper');
  const at = (azimuth, elevation, r = radius) => along(centre, [
    Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation)], r);
  const turns = Array.from({ length: 73 }, (_, k) => (k * Math.PI) / 36);
  context.globalAlpha = 0.45;
  for (const degree of [-60, -30, 0, 30, 60].filter((value) => value >= Math.min(lowest - 15, 0))) {
    path(context, turns.map((turn) => at(turn, (degree * Math.PI) / 180)), muted, 0.9);
  }
  context.globalAlpha = 1;
  [['x', [1, 0, 0]], ['y', [0, 1, 0]], ['z', [0, 0, 1]]].forEach(([name, axis]) => {
    path(context, Array.from({ length: 21 }, (_, k) => along(centre, axis, radius * (1 + k * 0.005))), ink, 1.4);
    const [x, y, key] = sphere.project(along(centre, axis, 1.16 * radius));
    if (!sphere.hides(x, y, key)) write(context, name, x, y, ink, paper, 13);
  });
}

// Draw the sensor as a pyramid with its wide side along the baseline, which shows the roll.
function drawSensor(context, i, colour) {
  const apex = along(centre, views.direction[i], radius), turn = views.turn[i];
  const column = (k) => turn.map((row) => row[k]);
  const base = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => along(
    along(along(apex, column(0), 0.16 * a * radius), column(1), 0.1 * b * radius), views.direction[i], -0.3 * radius));
  for (let k = 0; k < 4; k++) {
    path(context, [apex, base[k]], colour, 1.4);
    path(context, [base[k], base[(k + 1) % 4]], colour, k === 0 ? 3 : 1.4);
  }
}

// Draw the names of the features at the centre of their points, or in the next free line below, and a scale.
function drawNames(context) {
  const ink = style('--ink'), paper = style('--paper'), line = 15, written = [];
  if (state.cloud !== undefined) {
    context.font = font(12);
    const { places: where, feature } = cloud(state.cloud), count = feature.length;
    data.features.forEach(({ name }, k) => {
      const mean = [0, 0, 0];
      let number = 0;
      for (let i = 0; i < count; i++) {
        if (feature[i] !== k) continue;
        number++;
        for (let axis = 0; axis < 3; axis++) mean[axis] += where[axis * count + i];
      }
      if (!number) return;
      let [x, y] = seen.project(mean.map((value) => value / number));
      const half = context.measureText(name).width / 2;
      while (written.some((one) => Math.abs(one.x - x) < one.half + half && Math.abs(one.y - y) < line)) y += line;
      written.push({ x, y, half });
      write(context, name, x, y, ink, paper);
    });
  }
  const [length, wide] = seen.scaleBar(), y = seen.height - 14;
  Object.assign(context, { fillStyle: ink });
  context.fillRect(14, y, wide, 2);
  context.fillRect(14, y - 4, 1, 10);
  context.fillRect(13 + wide, y - 4, 1, 10);
  write(context, `${length} mm`, 14 + wide / 2, y - 11, ink, paper, 11);
}
