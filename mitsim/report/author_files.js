// Make the files that the page writes: the scene's XML with new names and finishes, the task, the study.

const data = JSON.parse(document.getElementById('author-data').textContent);
const scene = new DOMParser().parseFromString(data.xml, 'application/xml');
const shapeNodes = new Map([...scene.querySelectorAll('scene > shape[id]')].map((node) => [node.getAttribute('id'), node]));
const defaults = new Map([...scene.querySelectorAll('scene > default')].map((node) => [node.getAttribute('name'), node.getAttribute('value')]));
const NAME = /^\p{L}[\p{L}\p{M}\p{N}_-]{0,79}$/u;

const child = (node, name) => [...node.children].find((one) => one.getAttribute('name') === name);
const written = (node, name) => child(node, name)?.getAttribute('value') ?? '';
const resolved = (text) => (text.startsWith('$') ? defaults.get(text.slice(1)) ?? '' : text);

// Read a finish of the scene. Only metals can be edited here; other finishes can be assigned to faces.
function readFinish(node) {
  const type = node.getAttribute('type'), value = (name) => resolved(written(node, name));
  return { id: node.getAttribute('id'), type, node, metal: value('metal'), process: value('process'), Ra: value('Ra') };
}

const finishes = [...scene.querySelectorAll('scene > bsdf[id]')].map(readFinish);
const faces = data.solid.faces.map((face, number) => {
  const node = shapeNodes.get(face.name);
  const refs = node ? [...node.querySelectorAll(':scope > ref')].map((ref) => ref.getAttribute('id')) : [];
  return { ...face, number, node, finish: refs.find((id) => finishes.some((one) => one.id === id)) ?? '' };
});
const features = new Map(Object.entries(data.features));
const measurements = new Map(Object.entries(data.measurements));

// Add a feature without a face of its own, such as the rim of a bore, to those that can be chosen.
function addConstructed(name) {
  const made = { name, number: faces.length, node: null, finish: '', triangles: 0, anchor: geometry(name).point_mm ?? null, size: [0, 0, 0], area: null, constructed: true };
  faces.push(made);
  return made;
}

const CONSTRUCTED = new Set(['circle', 'edge_point', 'intersection', 'mid_plane']);
[...features].filter(([name, one]) => CONSTRUCTED.has(one.kind) && !faces.some((face) => face.name === name)).forEach(([name]) => addConstructed(name));

function renameKey(map, before, after) {
  const entries = [...map].map(([key, value]) => [key === before ? after : key, value]);
  map.clear();
  entries.forEach(([key, value]) => map.set(key, value));
}

// Rename a face everywhere; return the fault of the new name, or an empty text.
function renameFace(face, name) {
  if (name === face.name) return '';
  if (!NAME.test(name)) return 'letters, digits, - and _, a letter first';
  if (faces.some((one) => one.name === name) || features.has(name)) return `${name} exists already`;
  const before = face.name, swap = (list) => list?.map((one) => (one === before ? name : one));
  renameKey(features, before, name);
  features.forEach((one) => { if (one.of) one.of = swap(one.of); });
  measurements.forEach((one) => { one.features = swap(one.features); });
  data.findings.forEach((one) => { if (one.about === before) one.about = name; });
  face.node?.setAttribute('id', name);
  face.name = name;
  return '';
}

function giveFinish(face, id) {
  face.finish = id;
  [...face.node.children].filter((one) => one.tagName === 'bsdf'
    || (one.tagName === 'ref' && finishes.some((finish) => finish.id === one.getAttribute('id')))).forEach((one) => one.remove());
  const ref = scene.createElement('ref');
  ref.setAttribute('id', id);
  face.node.append(ref, '\n    ');
}

function changeFinish(finish, key, value) {
  finish[key] = value;
  const existing = child(finish.node, key), node = existing ?? scene.createElement(key === 'Ra' ? 'float' : 'string');
  node.setAttribute('name', key);
  node.setAttribute('value', value);
  if (!existing) finish.node.append(node);
}

function newFinish() {
  let count = finishes.length + 1;
  while (scene.querySelector(`[id="finish_${count}"]`)) count++;
  const node = scene.createElement('bsdf'), first = scene.querySelector('scene > shape');
  node.setAttribute('type', 'machined_metal');
  node.setAttribute('id', `finish_${count}`);
  const made = { id: `finish_${count}`, type: 'machined_metal', node, metal: '', process: '', Ra: '' };
  const like = finishes.find((one) => one.type === 'machined_metal') ?? { metal: 'aluminium', process: 'ground', Ra: '0.4' };
  ['metal', 'process', 'Ra'].forEach((key) => {
    node.append('\n        ');
    changeFinish(made, key, like[key]);
  });
  node.append('\n    ');
  first.before(node, '\n    ');
  finishes.push(made);
  return made;
}

const SPRAY = 'sprayed_matt_white';

// Spray all faces matt white, or take the spray off again.
function spray(on) {
  if (on && !finishes.some((one) => one.id === SPRAY)) {
    const node = scene.createElement('bsdf');
    node.setAttribute('type', 'matt_white');
    node.setAttribute('id', SPRAY);
    scene.querySelector('scene > shape').before(node, '\n    ');
    finishes.push({ id: SPRAY, type: 'matt_white', node, metal: '', process: '', Ra: '' });
  }
  for (const face of faces.filter((one) => one.node && (one.finish === SPRAY) !== on)) {
    const next = on ? SPRAY : face.below;
    if (on) face.below = face.finish;
    if (next) giveFinish(face, next);
  }
}

// ---- the task and the study as text

const toml = (value) => (typeof value === 'string' ? JSON.stringify(value)
  : Array.isArray(value) ? `[${value.map(toml).join(', ')}]`
    : value !== null && typeof value === 'object' ? `{ ${Object.entries(value).map(([name, one]) => `${key(name)} = ${toml(one)}`).join(', ')} }`
      : String(value));
const key = (name) => (/^[A-Za-z0-9_-]+$/.test(name) ? name : JSON.stringify(name));

function table(title, values) {
  return [`[${title}]`, ...Object.entries(values).map(([name, value]) => `${key(name)} = ${toml(value)}`), ''];
}

function taskText() {
  return [
    `# Measurements of ${data.scene_file}: geometry in the part frame, in mm and deg (docs/reference/task.md).`, '',
    ...(features.size ? [...features].flatMap(([name, one]) => table(`features.${key(name)}`, one)) : ['[features]', '']),
    ...(data.decision ? table('decision', data.decision) : []),
    ...[...measurements].flatMap(([name, one]) => table(`measurements.${key(name)}`, one)),
  ].join('\n');
}

function studyText() {
  return [
    `# Find the best view of the sensor to measure ${data.scene_file}.`,
    `scene = ${toml(data.scene_file)}`, `task = ${toml(data.task_file)}`, `sensor = ${toml(data.sensor)}`, 'seed = 1', '',
    '[views]', 'subdivisions = 1                        # 42 directions; 2 has 162', 'rolls_deg = [0, 90]', '',
    '[check]', 'views = 2', '',
  ].join('\n');
}

// Return the texts by file; no study without measurements, or if the user has one.
function fileTexts() {
  const texts = { scene: `${new XMLSerializer().serializeToString(scene)}\n`, task: taskText() };
  if (measurements.size && !data.study_there) texts.study = studyText();
  return texts;
}

const FILE_NAMES = { scene: data.scene_file, task: data.task_file, study: 'study.toml' };
