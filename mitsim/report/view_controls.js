// Pointer, keyboard and buttons of the sphere, and the scales beside the pictures.

const section = document.getElementById('sphere');
const name = () => state.measurement.name;

// ---- scales

function ticks() {
  const { low, high } = state;
  if (!QUANTITIES[state.quantity].logarithmic) {
    const step = [0.05, 0.1, 0.2, 0.25, 0.5, 1, 2, 5, 10].find((one) => high / one <= 5.01) ?? high / 4;
    return Array.from({ length: Math.floor(high / step + 1e-9) + 1 }, (_, k) => k * step);
  }
  const decades = Array.from({ length: 25 }, (_, k) => 10 ** (k - 12));
  for (const steps of [[1, 2, 5], [1, 1.5, 2, 3, 5, 7], [1, 3], [1]]) {
    const found = decades.flatMap((decade) => steps.map((step) => step * decade)).filter((v) => v >= low * 0.999 && v <= high * 1.001);
    if (found.length > 2 && found.length < 8) return found;
  }
  return [low, high];
}

function scale(where, stops, label, marks) {
  const bar = element('div', { class: 'vs-scale', style: `background:linear-gradient(to right,${stops.join(',')})` });
  const under = marks.map(([share, text, more]) => element('span', { style: `left:${(100 * share).toFixed(2)}%` }, text,
    more ? element('small', {}, more) : null));
  where.replaceChildren(
    element('div', { class: 'vs-label' }, label), element('div', { class: 'vs-ends', 'aria-hidden': 'true' },
      element('span', {}, '◂ worse'), element('span', {}, 'better ▸')),
    bar, element('div', { class: 'vs-ticks' }, ...under),
  );
}

function drawScales() {
  const m = state.measurement, q = QUANTITIES[state.quantity];
  const ratio = state.quantity === 'uncertainty' && known(m.tolerance);
  const told = `${q.told} [${q.unit(m)}]${ratio ? '; second line: tolerance / uncertainty' : ''}${state.more ? '; values beyond have the end colour' : ''}`;
  const short = (v) => (state.quantity === 'points' ? counted(v) : state.quantity === 'uncertainty' ? twoDigits(v) : rounded(v, 2));
  scale(place('legend'), data.palette.views, told, state.order.length
    ? ticks().map((v) => [goodness(v), short(v), ratio ? twoDigits(m.tolerance / v) : '']) : []);
  if (!numbers.length) place('noise').replaceChildren();
  else if (state.paint === 'noise' && data.noise) {
    const [low, high] = data.noise, span = Math.log(high / low);
    const steps = Array.from({ length: 5 }, (_, k) => low * Math.exp((span * k) / 4));
    scale(place('noise'), data.palette.noise, 'expected noise σ of each point along the view ray [mm]; values beyond have the end colour',
      steps.map((v) => [1 - Math.log(v / low) / span, twoDigits(v), '']));
  } else {
    const swatch = (colour, text) => element('span', { class: 'vs-key' }, element('span', { class: 'swatch', style: `background:${colour}` }), text);
    place('noise').replaceChildren(...(state.paint === 'noise' ? ['These clouds have no noise values.']
      : [...data.features.map((feature) => swatch(feature.colour, feature.name)), swatch(style('--unlabelled'), 'no feature of the task')]));
  }
}

// ---- the cloud of the chosen view

function paintCloud() {
  const number = state.cloud;
  seen.points = null;
  if (number === undefined) return;
  const { places: where, noise, feature } = cloud(number), other = pixel(style('--unlabelled'));
  const scaleOf = Array.from({ length: 256 }, (_, k) => (k === 255 ? other : pixel(between(data.palette.noise, 1 - k / 254))));
  const colourOf = Array.from({ length: 256 }, (_, k) => (data.features[k] ? pixel(data.features[k].colour) : other));
  const colours = Uint32Array.from(state.paint === 'noise' ? noise : feature, (k) => (state.paint === 'noise' ? scaleOf : colourOf)[k]);
  seen.points = { places: where, colours, spacing: data.clouds[number].spacing ?? 1 };
}

// Show the cloud of the view itself, or else offer the closest one on the page.
function offerCloud() {
  const own = views.number[state.chosen], told = place('cloud-told');
  state.cloud = numbers.includes(own) ? own : undefined;
  const say = (number) => {
    const { shown, count } = data.clouds[number];
    return `${counted(shown)} of the ${counted(count)} points of view ${number}${shown < count ? ', evenly sampled' : ''}`;
  };
  if (state.cloud !== undefined) told.replaceChildren(say(own), '.');
  else if (!numbers.length) told.replaceChildren('This page has no predicted cloud.');
  else {
    const best = numbers.reduce((a, b) => (apart(b) < apart(a) ? b : a));
    const button = element('button', { type: 'button', 'data-cloud': best }, `Show the cloud of view ${best}, ${degrees(apart(best))} away`);
    told.replaceChildren(`The cloud of view ${own} is not on this page. `, button);
  }
  paintCloud();
}

// Angle between the chosen view's direction and another's [deg]; differences in roll or standoff add a small tie-breaker.
function apart(number) {
  const i = panel.at.get(number), c = state.chosen;
  return (separation(i, c) * 180) / Math.PI + 1e-3 * (views.roll_deg[i] !== views.roll_deg[c]) + 1e-3 * (views.standoff_mm[i] !== views.standoff_mm[c]);
}

function lookAsSensor() {
  const i = state.cloud === undefined ? state.chosen : panel.at.get(state.cloud), turn = views.turn[i];
  const column = (k, sign) => turn.map((row) => sign * row[k]);
  Object.assign(seen, { rows: [column(0, 1), column(1, -1), column(2, -1)], zoom: 1, shift: [0, 0] });
  seen.distance = Math.max(views.standoff_mm[i] / seen.reach, 2);
  seen.redraw();
}

// ---- choosing

function choose(i, { turn = true, told = true } = {}) {
  const m = state.measurement;
  state.chosen = i;
  panel.show(m, i);
  panel.best(m, state.order, i);
  offerCloud();
  lookAsSensor();
  if (turn) bringForward(i);
  sphere.redraw();
  const u = m.uncertainty[i], position = state.order.indexOf(i);
  const value = m.able[i] ? `uncertainty ${quantity(u, m.unit)}` : `not possible${panel.limitWords(m, i) && `, ${panel.limitWords(m, i)}`}`;
  const ordinal = position < 0 ? '' : `; number ${position + 1} of ${state.order.length} by ${QUANTITIES[state.quantity].told}`;
  const text = `View ${views.number[i]}, ${panel.poseWords(i)}: ${value}${ordinal}.`;
  if (told) place('status').textContent = text;
}

function repaint() {
  rank();
  drawScales();
  choose(state.chosen, { turn: false });
}

// Rotate the globe if necessary until the view faces the user: near the rim, left and right have little meaning.
function bringForward(i) {
  const d = views.direction[i];
  let back = sphere.rows[2];
  if (dot(back, d) > 0.72) return;
  if (dot(back, d) < -0.99) back = along(back, sphere.rows[0], 0.3);
  while (dot(back, d) < 0.8 * Math.hypot(...back)) back = along(back, d, 0.1);
  glide(Math.atan2(back[1], back[0]), Math.asin(back[2] / Math.hypot(...back)));
}

const globe = { azimuth: 0, elevation: 0.5 };

function lookAtGlobe(azimuth, elevation) {
  Object.assign(globe, { azimuth, elevation: Math.min(Math.max(elevation, -1.5), 1.5) });
  sphere.lookFrom(globe.azimuth, globe.elevation);
}

function glide(azimuth, elevation) {
  const still = matchMedia('(prefers-reduced-motion: reduce)').matches || document.hidden;
  const from = { ...globe }, started = performance.now();
  const way = Math.atan2(Math.sin(azimuth - from.azimuth), Math.cos(azimuth - from.azimuth));
  const move = (now) => {
    const t = still ? 1 : Math.min(Math.max((now - started) / 240, 0), 1), share = t * t * (3 - 2 * t);
    lookAtGlobe(from.azimuth + share * way, from.elevation + share * (elevation - from.elevation));
    sphere.redraw(t < 1);
    if (t < 1) requestAnimationFrame(move);
  };
  move(started);
}

// Return the next direction to the east (dx = 1) or north (dy = 1) on the globe, which are right and up on its near side;
// -1 if there is none within 60 degrees. At a pole the picture's own right and up are used.
function neighbour(dx, dy) {
  const here = views.direction[state.chosen], [x, y, z] = here, across = Math.hypot(x, y);
  const atPole = across < 0.05;
  const east = atPole ? sphere.rows[0] : [-y / across, x / across, 0];
  const north = atPole ? sphere.rows[1] : [(-z * x) / across, (-z * y) / across, across];
  let best = -1, least = Infinity;
  sites.forEach((those, site) => {
    const there = views.direction[those[0]], tangent = along(there, here, -dot(there, here));
    const cosine = (dx * dot(tangent, east) + dy * dot(tangent, north)) / Math.hypot(...tangent);
    const cost = separation(those[0], state.chosen) * (1 + 3 * (1 - cosine));
    if (site !== views.site[state.chosen] && cosine > 0.5 && cost < least && cost < 2) [best, least] = [site, cost];
  });
  return best;
}

function step(dx, dy) {
  const site = neighbour(dx, dy);
  if (site < 0) place('status').textContent = `No view farther ${dx > 0 ? 'right' : dx < 0 ? 'left' : dy > 0 ? 'up' : 'down'}.`;
  else choose(state.shown[site]);
}

function sibling(by) {
  const those = sites[views.site[state.chosen]];
  choose(those[(those.indexOf(state.chosen) + by + those.length) % those.length]);
}

function nth(number) {
  if (state.order.length >= number) choose(state.order[number - 1]);
  else place('status').textContent = `Only ${state.order.length} views can make ${name()}.`;
}

// ---- events

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const hint = place('hint');

const zoomSphere = handle(sphere, {
  dragged: (dx, dy) => lookAtGlobe(globe.azimuth - 0.01 * dx, globe.elevation + 0.01 * dy),
  clicked: (x, y) => {
    const hit = under(x, y);
    if (hit) choose(hit.i, { turn: false });
  },
  moved: (x, y) => {
    const hit = under(x, y), m = state.measurement;
    hint.hidden = !hit;
    sphere.canvas.style.cursor = hit ? 'pointer' : 'grab';
    if (!hit) return;
    const value = can(hit.i) ? QUANTITIES[state.quantity].text(m, QUANTITIES[state.quantity].of(m, hit.i)) : 'not possible';
    hint.textContent = `view ${hit.view}: ${value}`;
    Object.assign(hint.style, { left: `${hit.x}px`, top: `${hit.y - 16}px` });
  },
});
const zoomSeen = handle(seen, { dragged: (dx, dy) => seen.turn(-0.01 * dx, 0.01 * dy) });

// Return the view whose mark lies under the pointer, the one nearest to the user first.
function under(x, y) {
  const marks = (sphere.canvas.places ?? []).map((mark) => [Math.hypot(mark.x - x, mark.y - y) - 4 * (mark.near > 0), mark]);
  const [away, mark] = marks.reduce((a, b) => (b[0] < a[0] ? b : a), [13, null]);
  return away < 13 ? mark : null;
}

function onKeys(scene, zoom, act) {
  scene.canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === '+' || event.key === '=') zoom(1.25);
    else if (event.key === '-') zoom(0.8);
    else if (!act(event.key, event.shiftKey)) return;
    event.preventDefault();
  });
}

onKeys(sphere, zoomSphere, (key, shift) => {
  if (key in ARROWS && shift) lookAtGlobe(globe.azimuth + 0.15 * ARROWS[key][0], globe.elevation + 0.15 * ARROWS[key][1]);
  else if (key in ARROWS) step(...ARROWS[key]);
  else if (key === 'Home') nth(1);
  else if (/^[1-9]$/.test(key)) nth(Number(key));
  else if (key === 'PageDown' || key === 'PageUp') sibling(key === 'PageDown' ? 1 : -1);
  else return false;
  sphere.redraw();
  return true;
});
onKeys(seen, zoomSeen, (key) => {
  if (key in ARROWS) seen.turn(0.15 * ARROWS[key][0], 0.15 * ARROWS[key][1]);
  else if (key === 'Home') lookAsSensor();
  else return false;
  seen.redraw();
  return true;
});

const ACTIONS = {
  'sphere-in': () => zoomSphere(1.25), 'sphere-out': () => zoomSphere(0.8),
  'sphere-best': () => { sphere.zoom = 1; nth(1); },
  'seen-in': () => zoomSeen(1.25), 'seen-out': () => zoomSeen(0.8), 'seen-home': lookAsSensor,
};
section.addEventListener('click', (event) => {
  const { view, cloud: other, act, set } = event.target.closest('button')?.dataset ?? {};
  if (view) {
    const row = event.target.closest('#sphere-best') && [...place('best').rows].indexOf(event.target.closest('tr'));
    choose(panel.at.get(Number(view)));
    if (Number.isInteger(row)) place('best').rows[row]?.querySelector('button').focus(); // the table was rebuilt
  } else if (other) {
    state.cloud = Number(other);
    paintCloud();
    place('cloud-told').replaceChildren(`This is the cloud of view ${other}, ${degrees(apart(state.cloud))} away.`);
    lookAsSensor();
  } else if (act) ACTIONS[act]();
  else if (set) {
    state.set = state.set === data.sets[set] ? null : data.sets[set];
    section.querySelectorAll('button[data-set]').forEach((button) => button.setAttribute('aria-pressed', data.sets[button.dataset.set] === state.set));
    place('set-key').hidden = !state.set;
    sphere.redraw();
  }
});
section.addEventListener('change', ({ target }) => {
  if (target.name === 'sphere-quantity') state.quantity = target.value;
  else if (target.name === 'sphere-paint') state.paint = target.value;
  else state.measurement = data.measurements[target.value];
  if (target.name !== 'sphere-paint') return repaint();
  drawScales();
  paintCloud();
  seen.redraw();
});

function dress() {
  const greys = Array.from({ length: SHADES }, (_, k) => pixel(style('--part'), k / (SHADES - 1)));
  sphere.greys = seen.greys = greys;
  drawScales();
  paintCloud();
  sphere.redraw();
  seen.redraw();
}

matchMedia('(prefers-color-scheme: dark)').addEventListener('change', dress);
place('measurement').value = '0'; // a browser keeps form values when the page is reloaded
section.querySelectorAll('input[type=radio]').forEach((radio) => { radio.checked = radio.defaultChecked; });
section.classList.add('vs-alive');
rank();
const start = state.order[0] ?? 0;
lookAtGlobe(Math.atan2(views.direction[start][1], views.direction[start][0]) - 0.45, 0.5);
dress();
choose(start, { turn: false, told: false });
