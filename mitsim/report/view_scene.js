// Draw a part, points and marks on one canvas with a software depth buffer, so that it looks the same on every machine.
// Positions are in mm in the part frame. A camera is three unit rows (right, up, back toward the viewer), its target
// and its distance; drawing uses units of `reach`.

const SHADES = 64;

class Scene {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.rows = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    this.zoom = 1;
    this.shift = [0, 0];
    Object.assign(this, { centre: [0, 0, 0], reach: 1, distance: 5, solid: null, points: null, marks: () => {} }, view);
    this.layer = document.createElement('canvas');
    this.coarse = false;
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  // Draw at the next frame: coarsely during motion, and finely once it has stopped.
  redraw(moving = false) {
    this.coarse = moving;
    clearTimeout(this.rest);
    if (moving) this.rest = setTimeout(() => this.redraw(), 140);
    if (!this.pending) this.pending = requestAnimationFrame(() => this.draw());
  }

  // Project a place: x and y in CSS pixels, and a depth key that grows toward the viewer.
  project(place) {
    const [a, b, c] = place.map((value, axis) => (value - this.centre[axis]) / this.reach);
    const [right, up, back] = this.rows.map((row) => row[0] * a + row[1] * b + row[2] * c);
    const key = this.distance / Math.max(this.distance - back, 1e-3);
    return [this.middle[0] + this.scale * key * right, this.middle[1] - this.scale * key * up, key];
  }

  // Return the visible face at x, y, or -1; for a solid whose triangles have an owner.
  ownerAt(x, y) {
    const column = Math.floor(x * this.fineness), row = Math.floor(y * this.fineness);
    const inside = column >= 0 && row >= 0 && column < this.columns && row < this.lines;
    return inside ? this.owners[row * this.columns + column] - 1 : -1;
  }

  // Return whether the solid or the points occlude a point at x, y with this key.
  hides(x, y, key) {
    const column = Math.floor(x * this.fineness), row = Math.floor(y * this.fineness);
    if (column < 0 || row < 0 || column >= this.columns || row >= this.lines) return false;
    return this.keys[row * this.columns + column] > key * 1.002;
  }

  draw() {
    this.pending = null;
    const { canvas, context } = this, ratio = window.devicePixelRatio || 1;
    this.width = canvas.clientWidth;
    this.height = canvas.clientHeight;
    if (!this.width || !this.height) return;
    canvas.width = Math.round(this.width * ratio);
    canvas.height = Math.round(this.height * ratio);
    this.middle = [this.width / 2 + this.shift[0], this.height / 2 + this.shift[1]];
    this.scale = 0.46 * Math.min(this.width, this.height) * this.zoom;
    this.fineness = this.coarse ? 1 : Math.max(2, ratio); // samples across a CSS pixel
    this.rasterise();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    context.imageSmoothingQuality = 'high';
    context.drawImage(this.layer, 0, 0, this.width, this.height);
    this.marks(context);
  }

  rasterise() {
    const columns = Math.round(this.width * this.fineness), lines = Math.round(this.height * this.fineness);
    if (columns !== this.columns || lines !== this.lines) {
      Object.assign(this, { columns, lines, keys: new Float32Array(columns * lines) });
      this.owners = new Uint16Array(columns * lines); // visible face, from 1; 0 for none
      this.image = new ImageData(columns, lines);
      this.pixels = new Uint32Array(this.image.data.buffer);
      Object.assign(this.layer, { width: columns, height: lines });
    }
    this.keys.fill(0);
    this.owners.fill(0);
    this.pixels.fill(0);
    if (this.solid) {
      this.drawSolid();
      this.drawEdges();
    }
    if (this.points) this.drawPoints();
    this.layer.getContext('2d').putImageData(this.image, 0, 0);
  }

  // Convert places (planes x, y, z) to columns, lines and keys of the raster.
  cast(places) {
    const count = places.length / 3, [right, up, back] = this.rows, near = this.distance;
    const seen = { x: new Float32Array(count), y: new Float32Array(count), key: new Float32Array(count) };
    const scale = this.scale * this.fineness, x0 = this.middle[0] * this.fineness, y0 = this.middle[1] * this.fineness;
    for (let i = 0; i < count; i++) {
      const a = (places[i] - this.centre[0]) / this.reach;
      const b = (places[count + i] - this.centre[1]) / this.reach;
      const c = (places[2 * count + i] - this.centre[2]) / this.reach;
      const key = near / Math.max(near - (back[0] * a + back[1] * b + back[2] * c), 1e-3);
      seen.x[i] = x0 + scale * key * (right[0] * a + right[1] * b + right[2] * c);
      seen.y[i] = y0 - scale * key * (up[0] * a + up[1] * b + up[2] * c);
      seen.key[i] = key;
    }
    return seen;
  }

  drawSolid() {
    const { vertices, normals, triangles } = this.solid, { x, y, key } = this.cast(vertices);
    const count = x.length, shade = new Float32Array(count), { owner } = this.solid;
    let colours = this.greys;
    const light = [0.42, 0.22, 0.88]; // from above the viewer's left shoulder, in camera rows
    for (let i = 0; i < count; i++) {
      const n = this.rows.map((row) => row[0] * normals[i] + row[1] * normals[count + i] + row[2] * normals[2 * count + i]);
      const side = n[2] < 0 ? -1 : 1; // sheets are visible from both sides
      const lit = side * (-light[0] * n[0] + light[1] * n[1] + light[2] * n[2]) / 127;
      shade[i] = (SHADES - 1) * (0.35 + 0.65 * Math.min(Math.max(0, lit), 1));
    }
    for (let t = 0; t < triangles.length; t += 3) {
      const i = triangles[t], j = triangles[t + 1], k = triangles[t + 2];
      if (owner) colours = this.paints[owner[t / 3]];
      const area = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i]);
      if (area === 0) continue;
      const left = Math.max(0, Math.ceil(Math.min(x[i], x[j], x[k]) - 0.5));
      const right = Math.min(this.columns - 1, Math.floor(Math.max(x[i], x[j], x[k]) - 0.5));
      const top = Math.max(0, Math.ceil(Math.min(y[i], y[j], y[k]) - 0.5));
      const bottom = Math.min(this.lines - 1, Math.floor(Math.max(y[i], y[j], y[k]) - 0.5));
      // the weights of the corners j and k change linearly along a row
      const stepJ = (y[k] - y[i]) / area, stepK = -(y[j] - y[i]) / area;
      for (let row = top; row <= bottom; row++) {
        const dx = left + 0.5 - x[i], dy = row + 0.5 - y[i];
        let ofJ = (dx * (y[k] - y[i]) - dy * (x[k] - x[i])) / area;
        let ofK = (dy * (x[j] - x[i]) - dx * (y[j] - y[i])) / area;
        for (let column = left, at = row * this.columns + left; column <= right; column++, at++) {
          const ofI = 1 - ofJ - ofK;
          if (ofI >= -1e-6 && ofJ >= -1e-6 && ofK >= -1e-6) {
            const near = ofI * key[i] + ofJ * key[j] + ofK * key[k];
            if (near > this.keys[at]) {
              this.keys[at] = near;
              if (owner) this.owners[at] = owner[t / 3] + 1;
              this.pixels[at] = colours[(ofI * shade[i] + ofJ * shade[j] + ofK * shade[k]) | 0];
            }
          }
          ofJ += stepJ;
          ofK += stepK;
        }
      }
    }
  }

  // Darken creases and ends between neighbouring pixels. The key of a plane is linear in the picture, so its second
  // difference is 0; that of an edge is the change of slope, in units of a slope of 45 degrees.
  drawEdges() {
    const { keys, pixels, columns, lines } = this, least = 0.5 / (this.distance * this.scale * this.fineness);
    for (let row = 1; row < lines - 1; row++) {
      for (let at = row * columns + 1; at < (row + 1) * columns - 1; at++) {
        if (!keys[at]) continue;
        const twice = 2 * keys[at];
        const bent = Math.abs(keys[at - 1] + keys[at + 1] - twice) > least
          || Math.abs(keys[at - columns] + keys[at + columns] - twice) > least;
        if (bent) pixels[at] = (((pixels[at] & 0xfefefe) >> 1) | 0xff000000) >>> 0;
      }
    }
  }

  drawPoints() {
    const { places, colours, spacing } = this.points, { x, y, key } = this.cast(places);
    const across = (1.15 * spacing / this.reach) * this.scale * this.fineness;
    const size = Math.min(Math.max(Math.round(across), this.fineness > 1 ? 2 : 1), 14), half = size / 2;
    for (let i = 0; i < x.length; i++) {
      if (!colours[i]) continue;
      const left = Math.round(x[i] - half), top = Math.round(y[i] - half);
      const near = key[i] * 1.004; // noise may put a point just behind its own face
      for (let row = Math.max(top, 0); row < Math.min(top + size, this.lines); row++) {
        for (let column = Math.max(left, 0); column < Math.min(left + size, this.columns); column++) {
          const at = row * this.columns + column;
          if (near > this.keys[at]) {
            this.keys[at] = near;
            this.pixels[at] = colours[i];
          }
        }
      }
    }
  }

  // Rotate about the vertical and the horizontal of the picture by angles [rad].
  turn(about, over) {
    const [right, up, back] = this.rows;
    const mix = (p, q, c, s) => p.map((value, axis) => c * value + s * q[axis]);
    const [c, s, d, t] = [Math.cos(about), Math.sin(about), Math.cos(over), Math.sin(over)];
    const sideways = mix(right, back, c, s), middle = mix(back, right, c, -s);
    this.rows = [sideways, mix(up, middle, d, -t), mix(middle, up, d, t)];
  }

  lookFrom(azimuth, elevation) {
    const [c, s, d, t] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    this.rows = [[-s, c, 0], [-t * c, -t * s, d], [d * c, d * s, t]];
  }

  // Return a scale-bar length that fits the picture's corner: [mm, CSS pixels].
  scaleBar() {
    const perMm = this.scale / this.reach, most = 0.3 * this.width / perMm, decade = 10 ** Math.floor(Math.log10(most));
    const length = decade * [5, 2, 1].find((step) => step * decade <= most);
    return [length, length * perMm];
  }
}

// Handle pointer, wheel and two fingers on a scene: dragged(dx, dy), clicked(x, y), moved(x, y). The wheel zooms only with
// focus or Ctrl, so that the page scrolls otherwise.
function handle(scene, { dragged, clicked = () => {}, moved = () => {} }) {
  const { canvas } = scene, fingers = new Map();
  let travelled = 0, apart = 0;
  const at = (event) => [event.offsetX, event.offsetY];
  const spread = () => {
    const [p, q] = [...fingers.values()];
    return Math.hypot(p[0] - q[0], p[1] - q[1]);
  };
  const zoom = (factor) => {
    scene.zoom = Math.min(Math.max(scene.zoom * factor, 0.5), 20);
    scene.redraw(true);
  };
  canvas.addEventListener('pointerdown', (event) => {
    if (event.button === 1) return;
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, at(event));
    travelled = 0;
    if (fingers.size === 2) apart = spread();
  });
  canvas.addEventListener('pointermove', (event) => {
    const here = at(event), before = fingers.get(event.pointerId);
    if (!before) return moved(...here);
    fingers.set(event.pointerId, here);
    const dx = here[0] - before[0], dy = here[1] - before[1];
    travelled += Math.hypot(dx, dy);
    if (fingers.size === 2) {
      zoom(spread() / apart);
      apart = spread();
    } else if (travelled > 3) {
      if (event.shiftKey || event.buttons & 2) scene.shift = [scene.shift[0] + dx, scene.shift[1] + dy];
      else dragged(dx, dy);
      scene.redraw(true);
    }
  });
  canvas.addEventListener('pointerup', (event) => {
    if (fingers.size === 1 && travelled <= 3 && event.button === 0) clicked(...at(event));
    fingers.delete(event.pointerId);
  });
  canvas.addEventListener('pointercancel', (event) => fingers.delete(event.pointerId));
  canvas.addEventListener('pointerleave', () => moved(NaN, NaN));
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, { passive: false });
  return zoom;
}

function bytes(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

// Convert integer steps within a box (planes) to places in mm.
function places(steps, box) {
  const count = steps.length / 3;
  return Float32Array.from(steps, (step, i) => box.origin[Math.floor(i / count)] + step * box.step);
}

// Return a colour '#rrggbb' as a pixel of an ImageData (little-endian: alpha first).
function pixel(colour, light = 1) {
  const part = (from) => Math.round(Math.min(light * parseInt(colour.slice(from, from + 2), 16), 255));
  return ((255 << 24) | (part(5) << 16) | (part(3) << 8) | part(1)) >>> 0;
}

// Make an element with attributes and children; strings become text.
function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === true) made.setAttribute(key, '');
    else if (value !== false && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.flat().filter((child) => child !== null));
  return made;
}
