// The page itself: the picture, the choice of faces, the panels.

const place = (id) => document.getElementById(`author-${id}`);
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const chosen = []; // numbers of the chosen faces, in order of choice
const state = { hover: -1, more: false, paint: 'finish', dirty: false, words: [], lengths: 'm', forms: 'K' };

// ---- the picture

const { box } = data.solid;
const vertices = places(new Uint16Array(bytes(data.solid.vertices).buffer), box);
const triangles = new Uint32Array(bytes(data.solid.triangles).buffer);
const owner = new Uint16Array(triangles.length / 3);
faces.reduce((from, face) => owner.fill(face.number, from, from + face.triangles) && from + face.triangles, 0);
const count = vertices.length / 3, range = (axis) => {
  let [low, high] = [Infinity, -Infinity];
  for (let i = axis * count; i < (axis + 1) * count; i++) [low, high] = [Math.min(low, vertices[i]), Math.max(high, vertices[i])];
  return [low, high];
};
const ends = [0, 1, 2].map(range);
const view = new Scene(place('canvas'), {
  centre: ends.map(([low, high]) => (low + high) / 2), reach: Math.hypot(...ends.map(([low, high]) => high - low)) / 2 || 1, distance: 4,
  solid: { vertices, triangles, normals: new Int8Array(bytes(data.solid.normals).buffer), owner },
  marks: drawMarks,
});
view.paints = [];
const look = { azimuth: -1.05, elevation: 0.6 };
const turn = (azimuth, elevation) => {
  Object.assign(look, { azimuth, elevation: Math.min(Math.max(elevation, -1.55), 1.55) });
  view.lookFrom(look.azimuth, look.elevation);
};
turn(look.azimuth, look.elevation);

const shades = (colour) => Uint32Array.from({ length: SHADES }, (_, k) => pixel(colour, k / (SHADES - 1)));
const GROUPS = ['#ccd2da', '#e8b64c', '#7cc3ea', '#5ab898', '#d99ac0', '#f0e87a', '#c8a27a'];
const colourOf = (finish) => GROUPS[Math.max(finishes.findIndex((one) => one.id === finish), 0) % GROUPS.length];

function paint() {
  const table = new Map(), of = (colour) => table.get(colour) ?? table.set(colour, shades(colour)).get(colour);
  const measured = new Set([...measurements.values()].flatMap((one) => one.features));
  view.paints = faces.map((face) => of(chosen.includes(face.number) ? style('--chosen')
    : state.paint === 'measured' ? (measured.has(face.name) ? '#7cc3ea' : '#ccd2da')
      : state.paint === 'findings' ? (about(face).length ? '#e8b64c' : '#ccd2da') : colourOf(face.finish)));
  view.redraw();
}

// Return whether a line from a to b passes through a box.
function crosses([a, b], { left, right, top, bottom }) {
  let [from, to] = [0, 1];
  for (const [start, way, low, high] of [[a[0], b[0] - a[0], left, right], [a[1], b[1] - a[1], top, bottom]]) {
    if (Math.abs(way) < 1e-9) { if (start < low || start > high) return false; continue; }
    const ends = [(low - start) / way, (high - start) / way].sort((p, q) => p - q);
    [from, to] = [Math.max(from, ends[0]), Math.min(to, ends[1])];
  }
  return from <= to;
}

// Shifts of a text in px, nearest first.
const SHIFTS = [...Array(17 * 17).keys()].map((k) => [9 * (k % 17 - 8), 9 * (Math.floor(k / 17) - 8)])
  .sort((p, q) => Math.hypot(...p) - Math.hypot(...q) || q[1] - p[1]);

// Write a text near a place where it covers no other text and no line of another dimension.
function words(context, text, x, y, strong = false, own = null) {
  context.font = `${strong ? 600 : 400} 13px system-ui, "DejaVu Sans", sans-serif`;
  const wide = context.measureText(text).width;
  const boxAt = ([dx, dy]) => {
    const start = Math.min(Math.max(x + dx - wide / 2, 6), view.width - wide - 6);
    return { left: start - 4, right: start + wide + 4, top: y + dy - 10, bottom: y + dy + 9 };
  };
  const apart = (one) => !state.words.some((each) => one.left < each.right + 2 && each.left < one.right + 2 && one.top < each.bottom + 2 && each.top < one.bottom + 2);
  const clear = (one) => !state.lines.some((each) => each.own !== own && crosses(each.ends, one));
  const shift = SHIFTS.find((one) => apart(boxAt(one)) && clear(boxAt(one))) ?? SHIFTS.find((one) => apart(boxAt(one))) ?? [0, 0];
  const placed = boxAt(shift), left = placed.left + 4;
  y = placed.top + 10;
  state.words.push({ ...placed, own });
  context.fillStyle = style('--paper');
  context.globalAlpha = 0.88;
  context.fillRect(left - 4, y - 10, wide + 8, 19);
  context.globalAlpha = 1;
  context.fillStyle = style('--ink');
  context.fillText(text, left, y + 4);
}

function line(context, a, b, width, arrows, own = null) {
  const [p, q] = [view.project(a), view.project(b)];
  state.lines.push({ ends: [p, q], own });
  context.lineWidth = width;
  context.beginPath();
  context.moveTo(p[0], p[1]);
  context.lineTo(q[0], q[1]);
  context.stroke();
  const way = Math.atan2(q[1] - p[1], q[0] - p[0]);
  const head = ([x, y], angle) => {
    context.beginPath();
    context.moveTo(x, y);
    [-0.3, 0.3].forEach((off) => context.lineTo(x - 9 * Math.cos(angle + off), y - 9 * Math.sin(angle + off)));
    context.fill();
  };
  if (arrows) head(q, way);
  if (arrows === true) head(p, way + Math.PI);
}

function drawMarks(context) {
  [state.words, state.lines] = [[], []]; // texts avoid them
  const texts = [];
  context.strokeStyle = context.fillStyle = style('--ink');
  for (const one of measurements.values()) {
    const drawn = dimension(one);
    if (!drawn) continue;
    context.strokeStyle = context.fillStyle = style('--dimension');
    context.setLineDash([3, 3]);
    drawn.thin.forEach(([a, b]) => line(context, a, b, 1, false, one));
    context.setLineDash([]);
    drawn.lines.forEach(([a, b]) => line(context, a, b, 1.6, drawn.arrows, one));
    if (drawn.arc) {
      const [corner, a, b] = drawn.arc.map((one_) => view.project(one_)), angle = (p) => Math.atan2(p[1] - corner[1], p[0] - corner[0]);
      const from = angle(a), to = angle(b), gap = Math.atan2(Math.sin(to - from), Math.cos(to - from));
      context.beginPath();
      context.arc(corner[0], corner[1], 24, from, from + gap, gap < 0);
      context.stroke();
    }
    const [x, y] = view.project(drawn.at);
    texts.push([dimensionText(one), x, y, false, one]);
  }
  texts.forEach((text) => words(context, ...text));
  chosen.forEach((number, i) => {
    const face = faces[number];
    if (!face.anchor) return;
    const [x, y] = view.project(face.anchor);
    context.fillStyle = style('--ink');
    context.beginPath();
    context.arc(x, y, 3.5, 0, 7);
    context.fill();
    words(context, chosen.length > 1 ? `${i + 1} ${face.name}` : face.name, x, y - 16, true);
  });
  view.canvas.drawn = { words: state.words, lines: state.lines }; // for tests
  if (state.hover >= 0 && !chosen.includes(state.hover)) words(context, faces[state.hover].name, state.x, state.y - 18);
}

// ---- choosing

const about = (face) => data.findings.filter((one) => one.about === face.name);

function choose(number, more = false) {
  const at = chosen.indexOf(number);
  if (!more) chosen.length = 0;
  if (number >= 0 && at < 0) chosen.push(number);
  else if (more && at >= 0) chosen.splice(at, 1);
  else if (!more && number >= 0) chosen.push(number);
  show();
}

function say(text, bad = false) {
  place('status').textContent = text;
  place('status').classList.toggle('au-bad', bad);
}

function touched() {
  state.dirty = true;
  place('save').textContent = data.served ? 'Save' : 'Download files';
  show();
}

// ---- panels

const option = (value, text, selected) => element('option', { value, selected }, text);
const field = (label, input, wide = false) => element('label', { class: wide ? 'au-field au-wide' : 'au-field' }, element('span', {}, label), input);
const button = (text, act, attributes = {}) => {
  const made = element('button', { type: 'button', ...attributes }, text);
  made.addEventListener('click', act);
  return made;
};
const select = (options, value, change, attributes = {}) => {
  const made = element('select', attributes, ...options.map(([key_, text]) => option(key_, text, key_ === value)));
  made.addEventListener('change', () => change(made.value));
  return made;
};
const entry = (value, change, attributes = {}) => {
  const made = element('input', { value, autocomplete: 'off', spellcheck: 'false', ...attributes });
  made.addEventListener('change', () => change(made.value, made));
  made.addEventListener('keydown', (event) => { if (event.key === 'Enter') made.blur(); });
  return made;
};

const told = (finish) => (finish.type === 'machined_metal' ? `${finish.metal}, ${finish.process}, Ra ${finish.Ra}` : finish.type);
const finishOptions = () => finishes.map((one) => [one.id, `${told(one)} (${one.id})`]);

function finding(one) {
  const sign = { error: '✖ error', warning: '▲ warning', note: '● note' }[one.severity];
  return element('li', { class: `au-${one.severity}` }, element('strong', {}, sign), one.about ? ` ${one.about}: ` : ' ', `${one.what}. ${one.advice}`);
}

// Return a remark that needs no check by mitsim: a finish or Ra outside the usual range or the map.
function finishRemark(finish) {
  if (finish.type !== 'machined_metal') return '';
  const Ra = Number(finish.Ra), usual = data.processes[finish.process];
  if (!(Ra > 0)) return '▲ Ra must be a number of um over 0';
  if (usual && (Ra < usual[0] || Ra > usual[1])) return `▲ ${finish.process} metal usually has Ra ${usual[0]} to ${usual[1]} um`;
  const known = data.known?.[`${finish.metal}/${finish.process}`];
  if (!data.known || (known && (!known.length || (Ra >= known[0] && Ra <= known[1])))) return '';
  const has = known ? `${finish.metal}/${finish.process} only of Ra ${known[0]} to ${known[1]} um` : `no ${finish.metal}/${finish.process}`;
  return `● the map of ${data.sensor} has ${has}: views are ranked by its nearest finish; virtual measurements use this one`;
}

// Say what a feature without a face of its own is.
function constructedText(one) {
  if (one.kind === 'circle') return `rim, a circle of diameter ${short(2 * one.radius_mm)} mm in ${one.of[0]}`;
  const words = { edge_point: 'point of an edge of', intersection: 'point where these meet:', mid_plane: 'plane midway between' };
  return `${words[one.kind] ?? one.kind} ${(one.of ?? []).join(', ')}`;
}

function facePanel() {
  const panel = place('face');
  if (!chosen.length) {
    panel.replaceChildren(element('p', { class: 'quiet' }, 'Click a face of the part or in the list. Ctrl or Shift adds to the choice.'));
    return;
  }
  const those = chosen.map((number) => faces[number]), [face] = those, one = those.length === 1;
  const kind = features.get(face.name)?.kind;
  const parts = [];
  if (one) {
    const size = face.size.map(short).join(' × ');
    parts.push(field('Name', entry(face.name, (value, input) => {
      const fault = renameFace(face, value.trim());
      if (fault) {
        say(`The name ${value}: ${fault}`, true);
        input.value = face.name;
      } else touched();
    }, { id: 'author-name', disabled: !face.node && !face.constructed })));
    if (face.constructed) parts.push(element('p', { class: 'quiet' }, constructedText(features.get(face.name))));
    else parts.push(element('p', { class: 'quiet' }, `${kind ?? 'not measurable: neither plane, cylinder, cone nor sphere'}; box around it ${size} mm, area ${face.area === null ? 'not known' : `${short(face.area)} mm²`}`));
  } else parts.push(element('p', {}, `${those.length} faces: ${those.map((each) => each.name).join(', ')}`));
  if (those.every((each) => each.constructed)) return panel.replaceChildren(...parts);
  const same = those.every((each) => each.finish === face.finish) ? face.finish : '';
  const options = [...(same ? [] : [['', '(several, or unnamed)']]), ...finishOptions(), ['+', 'a new finish']];
  parts.push(field('Finish', select(options, same, (value) => {
    if (!value) return;
    const id = value === '+' ? newFinish().id : value;
    those.filter((each) => each.node).forEach((each) => giveFinish(each, id));
    touched();
  }, { id: 'author-finish' }), true));
  const found = those.flatMap(about);
  if (found.length) parts.push(element('ul', { class: 'au-findings' }, ...found.map(finding)));
  panel.replaceChildren(...parts);
}

function measurePanel() {
  const names = chosen.map((number) => faces[number].name), offers = possible(names), panel = place('measure');
  if (!chosen.length) return panel.replaceChildren(element('p', { class: 'quiet' }, 'Choose one face for a size or form, two for a distance, an angle or an orientation.'));
  const constructions = [
    ['rim', rim(names), 'its rim here', 'the circle in which the round face leaves the plane. It is seen where the wall is not.'],
    ['midway', midway(names), 'the plane midway', 'the plane midway between both faces.'],
  ].filter(([, made]) => made).map(([id, made, what, is]) => {
    const there = faces.some((face) => face.name === made.name);
    return element('p', {}, button(`${there ? 'Choose' : 'Add'} ${what}`, () => {
      if (!there) {
        features.set(made.name, made.feature);
        addConstructed(made.name);
        say(`Added ${made.name}: ${is}`);
        state.dirty = true;
      }
      choose(faces.findIndex((face) => face.name === made.name));
    }, { id: `author-${id}` }));
  });
  if (!offers.length) return panel.replaceChildren(...constructions, element('p', { class: 'quiet' }, 'A task has no measurement for this choice of faces.'));
  let offer = offers.find((one) => one.kind === state.kind) ?? offers[0];
  const value = element('output', { class: 'au-value' }), unit_ = element('span', {}, '');
  const tolerance = element('input', { id: 'author-tolerance', autocomplete: 'off', size: 9 });
  const choice = select(offers.map((one) => [one.kind, one.kind.replaceAll('_', ' ')]), offer.kind, (kind) => {
    state.kind = kind;
    offer = offers.find((one) => one.kind === kind);
    shown();
  }, { id: 'author-kind' });
  const shown = () => {
    const zone = data.kinds[offer.kind].zone;
    value.textContent = zone ? 'a zone' : `${short(offer.nominal)} ${offer.unit === 'deg' ? '°' : 'mm'}`;
    unit_.textContent = zone ? `Tolerance [${offer.unit}]` : `Tolerance [${offer.unit}]: ±, or +upper −lower`;
  };
  const addIt = () => {
    const { zone } = data.kinds[offer.kind], allowed = readTolerance(tolerance.value, zone);
    if (allowed === null) return say(wrongTolerance(tolerance.value, zone), true);
    const before = already(offer.kind, offer.features);
    if (before) return say(`${before} measures the same: change its tolerance in the list below`, true);
    const base = cut(`${offer.features.slice(0, 2).join('_to_')}_${offer.kind.split('_').at(-1)}`);
    let name = base, n = 1;
    while (measurements.has(name)) name = `${base}_${++n}`;
    measurements.set(name, { kind: offer.kind, features: offer.features, nominal: offer.nominal, unit: offer.unit, ...(allowed === undefined ? {} : { tolerance: allowed }) });
    say(`Added ${name}: ${dimensionText(measurements.get(name))}`);
    touched();
  };
  tolerance.addEventListener('keydown', (event) => { if (event.key === 'Enter') addIt(); });
  shown();
  panel.replaceChildren(
    field('Kind', choice), element('p', {}, 'Nominal: ', value), element('label', { class: 'au-field' }, unit_, tolerance),
    button('Add measurement', addIt, { id: 'author-add', class: 'au-main' }), ...constructions,
  );
}

function measurementList() {
  const rows = [...measurements].map(([name, one]) => {
    const nameBox = entry(name, (value, input) => {
      const wanted = value.trim();
      if (wanted === name) return;
      if (!NAME.test(wanted) || measurements.has(wanted)) {
        say(`The name ${wanted}: letters, digits, - and _, and not an existing name`, true);
        input.value = name;
        return;
      }
      renameKey(measurements, name, wanted);
      touched();
    }, { 'aria-label': `name of ${name}`, size: Math.max(12, Math.min(name.length, 48)) });
    const tolerance = entry(toleranceText(one.tolerance), (value, input) => {
      const { zone } = data.kinds[one.kind], allowed = readTolerance(value, zone);
      if (allowed === null) {
        say(wrongTolerance(value, zone), true);
        input.value = toleranceText(one.tolerance);
        return;
      }
      if (allowed === undefined) delete one.tolerance;
      else one.tolerance = allowed;
      touched();
    }, { 'aria-label': `tolerance of ${name}`, size: 9 });
    return element('tr', {}, element('td', {}, nameBox), element('td', {}, one.kind.replaceAll('_', ' ')), element('td', { class: 'au-names' }, one.features.join(', ')),
      element('td', { class: 'au-number' }, data.kinds[one.kind].zone ? 'zone' : `${short(one.nominal)} ${one.unit}`), element('td', {}, tolerance),
      element('td', {}, button('Remove', () => { measurements.delete(name); touched(); }, { 'aria-label': `remove ${name}` })));
  });
  const none = element('tr', {}, element('td', { colspan: 6, class: 'quiet' }, 'No measurements yet.'));
  fillTable(place('measurements'), ['Name', 'Kind', 'Faces', 'Nominal', 'Tolerance', ''], rows.length ? rows : [none]);
}

// Show rows below their heads; a narrow page shows each row as a card, with the head beside every cell.
function fillTable(table, heads, rows) {
  const head = element('tr', {}, ...heads.map((text) => element('th', { scope: 'col' }, text)));
  table.replaceChildren(element('thead', {}, head), element('tbody', {}, ...rows));
  for (const row of rows) {
    [...row.cells].forEach((one, k) => {
      if (one.colSpan === 1 && one.localName === 'td' && one.hasChildNodes()) one.dataset.label = heads[k];
    });
  }
}

// Give a class of general tolerances to all measurements without a tolerance.
function generalPanel() {
  const chosenClass = (id, options) => select(options, state[id], (value) => { state[id] = value; }, { id: `author-${id}`, 'aria-label': id === 'lengths' ? 'class of lengths and angles' : 'class of form' });
  const lengths = [['f', 'fine (f)'], ['m', 'medium (m)'], ['c', 'coarse (c)'], ['v', 'very coarse (v)']], forms = ['H', 'K', 'L'].map((one) => [one, one]);
  place('general').replaceChildren(
    element('span', {}, 'General tolerances, ISO 2768: '), chosenClass('lengths', lengths), ' ', chosenClass('forms', forms), ' ',
    button('Give to all without one', () => {
      const open = [...measurements.values()].filter((one) => one.tolerance === undefined);
      const given = open.filter((one) => {
        const wide = generalTolerance(one, state.lengths, state.forms);
        if (wide !== undefined) one.tolerance = wide;
        return wide !== undefined;
      });
      const rest = open.length - given.length;
      say(`${given.length} of ${open.length} measurements without a tolerance have one now${rest ? '; ISO 2768 has none for the others' : ''}.`);
      if (given.length) touched();
    }, { id: 'author-give' }),
  );
}

function finishList() {
  const rows = finishes.map((one) => {
    const used = faces.filter((face) => face.finish === one.id).length, metal = one.type === 'machined_metal';
    const change = (name) => (value) => { changeFinish(one, name, value); touched(); };
    const choices = (list, value) => [...new Set([value, ...list])].map((each) => [each, each]);
    const cells = metal ? [
      select(choices(data.metals, one.metal), one.metal, change('metal'), { 'aria-label': `metal of ${one.id}` }),
      select(choices(Object.keys(data.processes), one.process), one.process, change('process'), { 'aria-label': `process of ${one.id}` }),
      entry(one.Ra, change('Ra'), { 'aria-label': `Ra of ${one.id} in um`, size: 5, inputmode: 'decimal' }),
    ] : [one.type.replaceAll('_', ' '), '', ''];
    const remark = finishRemark(one);
    return element('tr', {}, element('th', { scope: 'row' }, element('span', { class: 'au-swatch', style: `background:${colourOf(one.id)}` }), one.id),
      ...cells.map((cell) => element('td', {}, cell)), element('td', { class: 'au-number' }, String(used)),
      element('td', {}, button('Choose these faces', () => {
        chosen.splice(0, Infinity, ...faces.filter((face) => face.finish === one.id).map((face) => face.number));
        show();
      }, { 'aria-label': `choose the faces of ${one.id}` }), remark ? element('div', { class: 'au-warning' }, remark) : null));
  });
  fillTable(place('finishes'), ['Finish', 'Metal', 'Process', 'Ra [um]', 'Faces', ''], rows);
  const real = faces.filter((face) => face.node), sprayed = real.length > 0 && real.every((face) => face.finish === SPRAY);
  const back = real.some((face) => face.below);
  place('coat').replaceChildren(...(sprayed && !back ? [] : [button(sprayed ? 'Take the spray off' : 'Spray all faces matt white', () => {
    spray(!sprayed);
    touched();
  }, { id: 'author-spray' })]));
}

function faceList() {
  place('faces').replaceChildren(...faces.map((face) => {
    const found = about(face), sign = found.some((one) => one.severity === 'error') ? ' ✖' : found.some((one) => one.severity === 'warning') ? ' ▲' : '';
    const made = element('button', { type: 'button', 'aria-pressed': String(chosen.includes(face.number)), 'data-face': face.number },
      face.constructed ? '◯ ' : element('span', { class: 'au-swatch', style: `background:${colourOf(face.finish)}` }), `${face.name}${sign}`);
    return element('li', {}, made);
  }));
}

function show() {
  const focused = document.activeElement?.dataset?.face;
  facePanel();
  measurePanel();
  measurementList();
  generalPanel();
  finishList();
  faceList();
  const general = data.findings.filter((one) => !faces.some((face) => face.name === one.about) && !(one.about === 'task' && measurements.size));
  place('findings').replaceChildren(...(general.length ? general.map(finding) : [element('li', { class: 'quiet' }, 'No problems found.')]));
  if (focused !== undefined) place('faces').querySelector(`[data-face="${focused}"]`)?.focus();
  paint();
}

place('faces').addEventListener('click', (event) => {
  const made = event.target.closest('button');
  if (made) choose(Number(made.dataset.face), event.ctrlKey || event.metaKey || event.shiftKey);
});

// ---- pointer and keyboard on the picture

view.canvas.addEventListener('pointerdown', (event) => { state.more = event.ctrlKey || event.metaKey || event.shiftKey; });
const zoom = handle(view, {
  dragged: (dx, dy) => turn(look.azimuth - dx / 150, look.elevation + dy / 150),
  clicked: (x, y) => {
    view.canvas.focus();
    const number = view.ownerAt(x, y);
    if (number >= 0 || !state.more) choose(number, state.more);
  },
  moved: (x, y) => {
    const number = Number.isFinite(x) ? view.ownerAt(x, y) : -1;
    if (number === state.hover && number < 0) return;
    Object.assign(state, { hover: number, x, y });
    if (!view.pending) view.redraw();
  },
});
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
view.canvas.addEventListener('keydown', (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const last = chosen.at(-1) ?? -1, step = (by) => choose((last + by + faces.length) % faces.length, event.shiftKey);
  const { key: pressed } = event;
  if (pressed in ARROWS) turn(look.azimuth + 0.15 * ARROWS[pressed][0], look.elevation + 0.15 * ARROWS[pressed][1]);
  else if (pressed === '+' || pressed === '=') zoom(1.25);
  else if (pressed === '-') zoom(0.8);
  else if (pressed === 'Home') { turn(-1.05, 0.6); Object.assign(view, { zoom: 1, shift: [0, 0] }); }
  else if (pressed === 'n' || pressed === 'N') step(1);
  else if (pressed === 'p' || pressed === 'P') step(-1);
  else if (pressed === 'Escape') choose(-1);
  else if (pressed === 'Enter') place('name')?.focus();
  else return;
  event.preventDefault();
  view.redraw();
});
place('paint').addEventListener('change', () => { state.paint = place('paint').value; paint(); });
place('nearer').addEventListener('click', () => zoom(1.25));
place('farther').addEventListener('click', () => zoom(0.8));

// ---- saving

function download(name, text) {
  const link = element('a', { href: URL.createObjectURL(new Blob([text], { type: 'application/octet-stream' })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

async function save(last) {
  const texts = fileTexts();
  if (!data.served) {
    Object.entries(texts).forEach(([what, text]) => download(FILE_NAMES[what], text));
    state.dirty = false;
    return say(`Downloaded: ${Object.keys(texts).map((what) => FILE_NAMES[what]).join(', ')}. Put them in the folder of the scene's meshes.`);
  }
  say('Saving and checking the scene...');
  try {
    const answer = await fetch(`${location.pathname}save`, { method: 'POST', body: JSON.stringify({ files: texts, done: last }) });
    const found = await answer.json();
    if (!answer.ok) return say(`Not saved: ${found.fault}`, true);
    data.findings = found.findings;
    state.dirty = false;
    show();
    say(`Saved: ${found.written.join(', ')}. ${found.findings.length} findings of mitsim check.`);
  } catch (fault) {
    say(`Not saved: the command that serves this page has ended (${fault.message})`, true);
  }
}

place('save').addEventListener('click', () => save(false));
place('done')?.addEventListener('click', async () => {
  // a page that is closed while the command checks the scene cannot send another request
  if (state.dirty) await save(true);
  else await fetch(`${location.pathname}done`, { method: 'POST', body: '{}' }).catch(() => {});
  if (state.dirty) return;
  say('Done. This page can be closed.');
});
addEventListener('beforeunload', (event) => { if (state.dirty) event.preventDefault(); });
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', paint);
document.body.classList.add('au-alive');
show();
