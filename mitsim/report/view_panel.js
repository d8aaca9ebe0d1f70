// The text panel of a view: its pose, its predicted uncertainty, the causes, and the ten best views. It is built from text nodes
// alone, so that a name is never markup.

const MINUS = '\u2212', NONE = '\u2013', SPACE = '\u00a0', TIMES = '\u00d7';
const TOP = 10;

const known = (value) => value !== null && Number.isFinite(value);
const signed = (text) => text.replace(/-/g, MINUS);
const rounded = (value, places = 0) => (known(value) ? signed((Number(value.toFixed(places)) + 0).toFixed(places)) : NONE);
const counted = (value) => (known(value) ? Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, '\u202f') : NONE);
const degrees = (value) => `${rounded(value)}°`;

// Two significant digits, as characterisation.words.numbers writes them.
function twoDigits(value) {
  if (!known(value)) return NONE;
  if (value === 0) return '0';
  const short = Number(value.toPrecision(2));
  return signed(short.toFixed(Math.max(1 - Math.floor(Math.log10(Math.abs(short))), 0)));
}

function quantity(value, unit) {
  if (!known(value)) return NONE;
  return unit === 'deg' ? `${twoDigits(value)}°` : `${twoDigits(value)}${SPACE}${unit}`;
}

function percent(share) {
  if (!known(share)) return NONE;
  if (share === 0) return `0${SPACE}%`;
  if (share > 0 && share < 0.0005) return `<${SPACE}0.1${SPACE}%`;
  if (share < 1 && share > 0.995) return `>${SPACE}99${SPACE}%`;
  return `${(100 * share).toFixed(share < 0.0995 ? 1 : 0)}${SPACE}%`;
}

const cell = (text, className) => element('td', { class: className }, text);
const rowHead = (...content) => element('th', { scope: 'row' }, ...content);

// Replace the rows of a table and label their cells by its heads, as mitsim.report.templates does for the page's own.
function replaceRows(body, rows) {
  const heads = [...body.closest('table').tHead.rows[0].cells].map((one) => {
    const copy = one.cloneNode(true);
    copy.querySelectorAll('br, small').forEach((part) => part.before(part.localName === 'br' ? ' ' : ', '));
    return copy.textContent;
  });
  body.replaceChildren(...rows);
  for (const row of body.rows) {
    [...row.cells].forEach((one, k) => {
      if (one.localName === 'td' && one.colSpan === 1) one.dataset.label = heads[k];
    });
  }
}

function viewButton(number, text, label) {
  return element('button', { type: 'button', 'data-view': number, 'aria-label': label }, text);
}

class Panel {
  constructor(data) {
    const { views } = data;
    this.data = data;
    const none = views.number.map(() => null);
    this.nothing = { name: '', points: none, sigma: none, in_sight: none, alone: none }; // for measurements without a shape
    this.at = new Map(views.number.map((number, i) => [number, i]));
    this.places = Object.fromEntries(
      ['title', 'pose', 'expected', 'siblings', 'features', 'path', 'path-note', 'best'].map((name) => [
        name, document.getElementById(`sphere-${name}`),
      ]),
    );
  }

  poseWords(i) {
    const { azimuth_deg, elevation_deg, roll_deg } = this.data.views;
    return `azimuth ${degrees(azimuth_deg[i])}, elevation ${degrees(elevation_deg[i])}, roll ${degrees(roll_deg[i])}`;
  }

  // Return the limit of a view for a measurement, in words; '' if there is none.
  limitWords(measurement, i) {
    const words = this.data.limits[measurement.limit[i]]?.words ?? measurement.limit[i];
    return [measurement.limiting[i], words].filter(Boolean).join(': ');
  }

  show(measurement, i) {
    const { views } = this.data, number = views.number[i], u = measurement.uncertainty[i];
    const marks = [
      measurement.rank[i] === 1 && measurement.able[i] && 'best',
      this.data.checked.includes(number) && 'rendered to check',
      ...this.data.sets.map((set, k) => set.views.includes(number) && `in set ${k + 1}`),
      !measurement.able[i] && 'not possible',
    ].filter(Boolean);
    this.places.title.replaceChildren(
      `View ${number} `, ...marks.map((mark) => element('span', { class: 'vs-mark' }, mark)),
    );
    const [x, y, z] = views.direction[i];
    this.list('pose', [
      ['Position x, y, z', `${views.position[i].map((value) => rounded(value)).join(', ')}${SPACE}mm`],
      ['Looks from', `azimuth ${degrees(views.azimuth_deg[i])}, elevation ${degrees(views.elevation_deg[i])}`],
      ['Direction', `(${[x, y, z].map((value) => rounded(value, 3)).join(', ')})`],
      ['Roll', degrees(views.roll_deg[i])],
      ['Standoff', `${rounded(views.standoff_mm[i])}${SPACE}mm`],
    ]);
    const limit = this.limitWords(measurement, i), remedy = this.data.limits[measurement.limit[i]]?.remedy;
    const error = measurement.error[number];
    this.list('expected', [
      ['Standard uncertainty', element('strong', {}, this.uncertainty(measurement, i))],
      ['Tolerance / uncertainty', known(measurement.tolerance) && measurement.able[i]
        ? `${twoDigits(measurement.tolerance / u)}, of a tolerance of ${measurement.tolerance}${measurement.unit === 'deg' ? '°' : SPACE + measurement.unit}`
        : known(measurement.tolerance) ? NONE : 'no tolerance is stated'],
      ['Chance of enough points', percent(measurement.chance[i])],
      ['Limited by', limit || 'no single cause'],
      ...(remedy ? [['Possible improvement', remedy]] : []),
      ['View score Vₘ', `${rounded(measurement.score[i], 2)}, rank ${counted(measurement.score_rank[i])} of ${counted(views.number.length)}`],
      ...(error !== undefined ? [['Error in a rendering', known(error) ? quantity(error, measurement.unit) : 'not measurable']] : []),
    ]);
    this.siblings(measurement, i);
    this.features(measurement, i);
    this.path(measurement, i);
  }

  uncertainty(measurement, i) {
    const u = measurement.uncertainty[i];
    if (measurement.able[i]) return quantity(u, measurement.unit);
    return known(u) ? `not possible; ${quantity(u, measurement.unit)} with enough points` : 'not possible';
  }

  list(place, rows) {
    this.places[place].replaceChildren(
      ...rows.flatMap(([term, value]) => [element('dt', {}, term), element('dd', {}, value)]),
    );
  }

  // List the other rolls and standoffs of one direction.
  siblings(measurement, i) {
    const { views } = this.data;
    const others = views.site.flatMap((site, k) => (site === views.site[i] && k !== i ? [k] : []));
    const buttons = others.map((k) => {
      const told = `roll ${degrees(views.roll_deg[k])}, ${rounded(views.standoff_mm[k])}${SPACE}mm`;
      const u = measurement.able[k] ? quantity(measurement.uncertainty[k], measurement.unit) : 'not possible';
      return viewButton(views.number[k], `${told}: ${u}`, `View ${views.number[k]}, ${told}, ${u}`);
    });
    const head = others.length ? 'From the same direction: ' : 'This direction has no other roll or standoff.';
    this.places.siblings.replaceChildren(head, ...buttons);
  }

  features(measurement, i) {
    const least = this.data.minimum_points;
    replaceRows(this.places.features, this.data.features.map((feature, k) => {
      const needed = measurement.features.includes(k), points = feature.points[i];
      const found = points >= least ? 'yes' : points > 0 ? `no, fewer than ${least}` : 'no';
      return element('tr', { class: needed ? '' : 'quiet' },
        rowHead(element('span', { class: 'swatch', style: `background:${feature.colour}` }), feature.name,
          needed ? null : element('small', {}, 'not needed here')),
        cell(found, 'left'), cell(counted(points)), cell(twoDigits(feature.sigma[i])), cell(percent(feature.in_sight[i])));
    }));
  }

  // Show the steps from the candidate to its rank beside those of the best view, each with its factor on the uncertainty.
  path(measurement, i) {
    const { views, features, minimum_points: least } = this.data;
    const possible = measurement.able.filter(Boolean).length;
    const b = measurement.rank.findIndex((rank, k) => rank === 1 && measurement.able[k]);
    const fewest = measurement.features.map((k) => features[k]).sort((p, q) => p.points[i] - q.points[i])[0];
    const feature = features.find(({ name }) => name === measurement.limiting[i]) ?? fewest ?? this.nothing;
    const given = (k) => feature.points[k] / (feature.alone[k] * feature.in_sight[k]);
    const ratio = (over, under) => (known(over) && known(under) && under > 0 ? over / under : NaN);
    const fewer = (of) => (b < 0 ? NaN : Math.sqrt(ratio(of(b), of(i))));
    const u = measurement.uncertainty;
    const factors = {
      room: fewer((k) => feature.alone[k]),
      sight: fewer((k) => feature.in_sight[k]),
      finish: fewer(given),
      noise: b < 0 ? NaN : ratio(feature.sigma[i], feature.sigma[b]),
      whole: b < 0 ? NaN : ratio(u[i], u[b]),
    };
    factors.geometry = factors.whole / (factors.room * factors.sight * factors.finish * factors.noise);
    const stop = measurement.able[i] ? '' : { occlusion: 'sight', 'few points': 'points', noise: 'noise' }[measurement.limit[i]] ?? 'geometry';
    const short = (k) => `view ${views.number[k]}`;
    const best = (text) => (b < 0 ? NONE : text(b));
    const more = (name, good, change) => {
      const f = factors[name];
      if (i === b || !Number.isFinite(f)) return '';
      return f > 1.05 ? change(f) : f < 0.95 ? 'better than in the best view' : good;
    };
    const steps = [
      ['', 'Candidate', short(i), best(short), null, `${this.poseWords(i)}, standoff ${rounded(views.standoff_mm[i])}${SPACE}mm`],
      ['room', 'Pixels in the image', counted(feature.alone[i]), best((k) => counted(feature.alone[k])), factors.room,
        more('room', 'equal', (f) => `${twoDigits(f * f)} times the pixels: closer or less oblique`)],
      ['sight', 'Not occluded by the part', percent(feature.in_sight[i]), best((k) => percent(feature.in_sight[k])), factors.sight,
        more('sight', 'equal', (f) => `${twoDigits(f * f)} times the visible share`)],
      ['finish', 'Recovered with this finish', percent(given(i)), best((k) => percent(given(k))), factors.finish,
        more('finish', 'equal', (f) => `${twoDigits(f * f)} times the share of points`)],
      ['points', 'Expected points', counted(feature.points[i]), best((k) => counted(feature.points[k])), null,
        feature === this.nothing ? '' : feature.points[i] < least
          ? `${feature.points[i] > 0 ? `${twoDigits(least / feature.points[i])} times as many: ` : ''}${counted(least)} are needed`
          : `${percent(measurement.chance[i])} chance of enough points`],
      ['noise', 'Noise σ of a point', quantity(feature.sigma[i], 'mm'), best((k) => quantity(feature.sigma[k], 'mm')), factors.noise,
        more('noise', 'equal', (f) => `${twoDigits(1 / f)} times the noise`)],
      ['geometry', 'Geometry and other causes', '', '', factors.geometry,
        more('geometry', 'equal', () => 'points over a longer distance or a larger angle, better other features, less correlated noise')],
      ['whole', 'Standard uncertainty', measurement.able[i] ? quantity(u[i], measurement.unit) : 'not possible',
        best((k) => quantity(u[k], measurement.unit)), factors.whole, ''],
      ['rank', 'Rank', measurement.able[i] ? `${counted(measurement.rank[i])} of ${counted(possible)}` : NONE, best(() => '1'), null,
        `${counted(possible)} of ${counted(views.number.length)} views can make the measurement`],
    ];
    const worst = Math.max(...Object.values(factors).filter(Number.isFinite).map((f) => Math.abs(Math.log(f))), Math.log(1.5));
    let passed = true;
    replaceRows(this.places.path, steps.map(([key, name, here, there, factor, change]) => {
      const stops = key !== '' && key === stop;
      const row = element('tr', { class: [stops ? 'vs-stop' : '', passed ? '' : 'quiet', ['whole', 'rank'].includes(key) ? 'strong' : ''].join(' ').trim() },
        rowHead(name), cell(here), cell(there, 'quiet'), this.factor(factor, worst),
        element('td', { class: 'left wrap' }, stops ? element('strong', {}, '✕ fails here. ') : null, change));
      passed &&= !stops;
      return row;
    }));
    this.places['path-note'].replaceChildren(this.summary(measurement, i, b, feature, factors));
  }

  factor(value, worst) {
    if (value === null || !Number.isFinite(value)) return cell(value === null ? '' : NONE, 'vs-factor');
    const width = Math.min(Math.abs(Math.log(value)) / worst, 1) * 50;
    const bar = element('span', { class: 'vs-bar', 'aria-hidden': 'true' },
      element('i', { style: `width:${width.toFixed(1)}%;${value > 1 ? 'left' : 'right'}:50%` }));
    return element('td', { class: 'vs-factor' }, `${TIMES}${SPACE}${twoDigits(value)}`, bar);
  }

  summary(measurement, i, b, feature, factors) {
    const limits = feature.name === measurement.limiting[i] ? ', which limits this view' : '';
    const on = feature === this.nothing ? '' : `For ${feature.name}${limits}. `;
    if (b < 0) return `${on}No view can make this measurement.`;
    if (i === b) return `${on}This is the best view for ${measurement.name}.`;
    if (!measurement.able[i]) return `${on}The view cannot make ${measurement.name}.`;
    const names = {
      room: 'the size in the image', sight: 'occlusion by the part', finish: 'the finish',
      noise: 'the noise of a point', geometry: 'geometry and other causes',
    };
    const causes = Object.keys(names).filter((key) => factors[key] > 1.05).sort((p, q) => factors[q] - factors[p]);
    const told = causes.slice(0, 2).map((key) => `${names[key]} (${TIMES}${SPACE}${twoDigits(factors[key])})`);
    const from = told.length ? `, mostly from ${told.join(' and ')}` : '';
    return `${on}${twoDigits(factors.whole)} times the uncertainty of view ${this.data.views.number[b]}${from}. This is the product of the factors.`;
  }

  // List the best views in an order (indices), with a button in each row.
  best(measurement, order, chosen) {
    const { views } = this.data;
    const rows = order.slice(0, TOP).map((i, place) => {
      const number = views.number[i], u = measurement.uncertainty[i], tolerance = measurement.tolerance;
      return element('tr', { 'aria-current': i === chosen ? 'true' : undefined },
        cell(`${place + 1}`), element('td', {}, viewButton(number, `${number}`, `Choose view ${number}`)),
        cell(quantity(u, measurement.unit), 'strong'), cell(known(tolerance) && u > 0 ? twoDigits(tolerance / u) : NONE),
        cell(percent(measurement.chance[i])), cell(rounded(measurement.score[i], 2)), cell(degrees(views.azimuth_deg[i])),
        cell(degrees(views.elevation_deg[i])), cell(degrees(views.roll_deg[i])), cell(rounded(views.standoff_mm[i])));
    });
    const none = element('tr', {}, element('td', { class: 'left', colspan: 10 }, 'no view can make this measurement'));
    replaceRows(this.places.best, rows.length ? rows : [none]);
  }
}
