// A mode in motion: Re(x e^{iφ}) with increasing phase φ, so that travelling waves run in the right direction.

import { next } from "./clock.js";
import { colour, fixed, known, signed } from "./format.js";

const at = (id) => document.getElementById(id);
/** Duration of a period on the screen, s. */
const PERIOD = 2.4;
/** Interval between updates of the slider while it plays, ms. */
const SLIDER_EVERY = 150;

/** Displacements at a phase: Re((re + i im) e^{iφ}). */
export function displaced(re, im, phase) {
  const [c, s] = [Math.cos(phase), Math.sin(phase)];
  return re.map((value, k) => value * c - im[k] * s);
}

/** Rotates the phase of a mode's new shape to match the previous one: the phase of a shape is arbitrary. */
function keepPhase(newer, older) {
  let [re, im] = [0, 0];
  newer.parts.forEach((part, p) => {
    const before = older.parts[p];
    part.re.forEach((value, k) => {
      re += value * before.re[k] + part.im[k] * before.im[k];
      im += value * before.im[k] - part.im[k] * before.re[k];
    });
  });
  const size = Math.hypot(re, im);
  if (!(size > 0)) return;
  const [c, s] = [re / size, im / size];
  for (const part of newer.parts) {
    part.re.forEach((value, k) => {
      part.re[k] = value * c - part.im[k] * s;
      part.im[k] = value * s + part.im[k] * c;
    });
  }
}

export class ShapeView {
  constructor() {
    this.canvas = at("shape");
    this.stage = at("stage");
    this.playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.phase = 0;
    this.shape = null;
    this.picture = null;
    this.visible = true;
    /** Whether the motion is stopped because nothing is known about the mode at present. */
    this.stopped = false;
    at("shape-play").addEventListener("click", () => this.#play(!this.playing));
    at("shape-phase").addEventListener("input", (event) => {
      this.#play(false);
      this.#turn(Number(event.target.value) * Math.PI / 180);
    });
    this.size = [this.stage.clientWidth, this.stage.clientHeight];
    this.frame = this.frame.bind(this);
    this.#play(this.playing);
    new ResizeObserver(() => {
      this.size = [this.stage.clientWidth, this.stage.clientHeight];
      this.#draw();
    }).observe(this.stage);
    new IntersectionObserver((entries) => {
      this.visible = entries.at(-1).isIntersecting;
      this.#run();
    }).observe(this.stage);
  }

  /** Stops the motion while nothing is known about the rig. */
  still(stopped) {
    if (stopped === this.stopped) return;
    this.stopped = stopped;
    this.stage.classList.toggle("still", stopped);
    this.#note();
    this.#run();
  }

  #note() {
    const { shape } = this;
    if (!shape) return;
    const growth = shape.growth_rate_per_s;
    const grown = growth > 0 ? "grows" : growth < 0 ? "decays" : "neither grows nor decays";
    const now = this.stopped ? "the last shape known" : `slowed down; it ${grown}`;
    at("shape-note").textContent = `mode ${shape.id}, ${fixed(shape.frequency_hz, shape.frequency_hz >= 100 ? 1 : 4)} Hz, ${now}`;
  }

  /** The names of the parts in their colours, and how far each moves. */
  #name(parts) {
    const largest = parts.map((part) => {
      const squares = part.re.map((re, k) => re * re + part.im[k] * part.im[k]);
      if (!part.spatial) return Math.sqrt(Math.max(0, ...squares));
      return Math.sqrt(squares.reduce((most, _, k) => (k % 3 ? most : Math.max(most, squares[k] + squares[k + 1] + squares[k + 2])), 0));
    });
    const most = Math.max(...largest);
    at("shape-parts").replaceChildren(...parts.map((part, p) => {
      const item = document.createElement("li");
      const swatch = document.createElement("span");
      swatch.className = `swatch part-${part.name}`;
      item.append(swatch, `${part.name} ${most > 0 ? fixed(100 * largest[p] / most, 0) : "0"} %`);
      return item;
    }));
  }

  /** Sensitivity of the growth rate to the conditions and to stiffness and damping of the contact. */
  #changes(change) {
    const named = { friction: "μ", load: "load", speed: "speed", contact_stiffness: "stiffness", contact_damping: "damping" };
    const entry = (kind, text) => Object.assign(document.createElement(kind), { textContent: text });
    const available = Object.entries(named).filter(([key]) => known(change?.[key]));
    const pairs = available.map(([key, name]) => {
      const pair = document.createElement("div");
      pair.append(entry("dt", name), entry("dd", change[key] === 0 ? "0" : signed(change[key], 2)));
      return pair;
    });
    const title = document.createElement("div");
    title.append(entry("dt", "+1 % of"), entry("dd", "growth"));
    at("shape-changes").replaceChildren(...(pairs.length ? [title, ...pairs] : []));
  }

  /** `way` is the sign of the disc speed. */
  async show(shape, way = 1) {
    const spatial = shape.parts.some((part) => part.spatial);
    this.wanted = shape;
    if (spatial) this.three ??= await import("./vendor/three.module.min.js");
    // Another shape was chosen while the library loaded.
    if (this.wanted !== shape) return;
    if (!(this.picture instanceof (spatial ? Space : Sticks))) {
      this.picture?.dispose();
      // A canvas keeps its first kind of context.
      const fresh = this.canvas.cloneNode();
      this.canvas.replaceWith(fresh);
      this.canvas = fresh;
      this.picture = spatial ? new Space(this.three, fresh) : new Sticks(fresh);
    }
    if (this.shape?.id === shape.id) keepPhase(shape, this.shape);
    this.shape = shape;
    this.#note();
    this.#name(shape.parts);
    this.#changes(shape.growth_change);
    this.canvas.setAttribute("aria-label", `Mode ${shape.id} in motion`);
    this.picture.take(shape, way);
    this.#draw();
    this.#run();
  }

  missing(reason) {
    at("shape-note").textContent = reason;
  }

  /** Redraws after a change of colours. */
  draw() {
    if (this.shape) this.picture.take(this.shape);
    this.#draw();
  }

  #play(playing) {
    this.playing = playing;
    this.sliderAt = undefined;
    const button = at("shape-play");
    button.textContent = playing ? "Pause" : "Play";
    button.setAttribute("aria-pressed", String(playing));
    this.#run();
  }

  #run() {
    if (this.running || this.stopped || !this.playing || !this.visible || !this.shape) return;
    this.running = true;
    this.before = performance.now();
    next(this.frame);
  }

  frame(now) {
    this.running = this.playing && this.visible && !this.stopped;
    if (!this.running) return;
    this.#turn(this.phase + 2 * Math.PI * Math.max(0, Math.min(0.2, (now - this.before) / 1000)) / PERIOD);
    this.before = now;
    next(this.frame);
  }

  #turn(phase) {
    this.phase = phase % (2 * Math.PI);
    const now = performance.now();
    // Updating the slider is costly: while playing it is done now and then.
    if (!this.playing || !(now - this.sliderAt < SLIDER_EVERY)) {
      this.sliderAt = now;
      const degrees = Math.round(this.phase * 180 / Math.PI) % 360;
      at("shape-phase").value = degrees;
      at("shape-degrees").textContent = `${degrees}°`;
    }
    this.#draw();
  }

  #draw() {
    // Without space, as in a window being closed, there is nothing to draw.
    if (!this.shape || !this.picture || Math.min(...this.size) < 50) return;
    this.picture.draw(this.phase, ...this.size);
  }
}

/** Numbered degrees of freedom: a stalk each, with its range behind it and its phase as a hand below it. */
class Sticks {
  constructor(canvas) {
    this.canvas = canvas;
    this.ctx = canvas.getContext("2d");
    // Static elements have their own canvas and are drawn once.
    this.behind = document.createElement("canvas");
    this.behind.setAttribute("aria-hidden", "true");
    canvas.before(this.behind);
  }

  take(shape) {
    this.shape = shape;
    this.paint = { ink: colour("--ink"), muted: colour("--muted"), grid: colour("--grid"), pad: colour("--pad"), disc: colour("--disc"), other: colour("--mode-2") };
    this.laidFor = undefined;
  }

  dispose() {
    this.behind.remove();
  }

  /** Computes the layout and draws the static elements. */
  #lay(width, height) {
    const { shape, paint } = this;
    const ratio = devicePixelRatio;
    this.laidFor = `${width} ${height} ${ratio}`;
    for (const canvas of [this.canvas, this.behind]) [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const ctx = this.behind.getContext("2d");
    for (const each of [this.ctx, ctx]) each.setTransform(ratio, 0, 0, ratio, 0, 0);
    const text = Math.max(11, Math.min(18, width / 34));
    ctx.font = `${text}px system-ui, sans-serif`;
    const count = shape.parts.reduce((sum, part) => sum + part.re.length, 0);
    const gaps = shape.parts.length - 1;
    const step = (width - 24) / (count + gaps);
    const dial = Math.min(step * 0.3, height * 0.06, 14);
    const middle = (height - 2 * dial - 2.2 * text) / 2 + text * 0.6;
    const head = Math.max(2.5, Math.min(9, step * 0.22));
    const reach = middle - text * 1.5 - head;
    const hands = height - dial - text * 1.35;
    let x = 12 + step / 2;
    const parts = shape.parts.map((part) => {
      const tone = paint[part.name] ?? paint.other;
      const first = x;
      ctx.fillStyle = paint.muted;
      ctx.textAlign = "left";
      ctx.fillText(part.name, first - step / 2 + 2, text);
      ctx.strokeStyle = paint.muted;
      ctx.lineWidth = 1;
      ctx.beginPath();
      ctx.moveTo(first - step / 2, middle);
      ctx.lineTo(first + step * (part.re.length - 0.5), middle);
      ctx.stroke();
      part.re.forEach((re, k) => {
        const magnitude = Math.hypot(re, part.im[k]);
        ctx.globalAlpha = 0.16;
        ctx.fillStyle = tone;
        ctx.fillRect(x - head, middle - magnitude * reach, 2 * head, 2 * magnitude * reach);
        ctx.globalAlpha = 1;
        ctx.strokeStyle = paint.grid;
        ctx.lineWidth = 1.5;
        ctx.beginPath();
        ctx.arc(x, hands, dial, 0, 2 * Math.PI);
        ctx.stroke();
        if (step > text * 0.9) {
          ctx.fillStyle = paint.muted;
          ctx.textAlign = "center";
          ctx.fillText(String(k + 1), x, height - 3);
        }
        x += step;
      });
      x += step;
      return { part, tone, first };
    });
    this.laid = { parts, step, dial, middle, head, reach, hands };
  }

  draw(phase, width, height) {
    const { ctx } = this;
    if (this.laidFor !== `${width} ${height} ${devicePixelRatio}`) this.#lay(width, height);
    const { parts, step, dial, middle, head, reach, hands } = this.laid;
    ctx.clearRect(0, 0, width, height);
    for (const { part, tone, first } of parts) {
      const heights = displaced(part.re, part.im, phase).map((value) => middle - value * reach);
      ctx.strokeStyle = ctx.fillStyle = tone;
      // The line through the heads shows the shape.
      ctx.lineWidth = 1;
      ctx.globalAlpha = 0.35;
      ctx.beginPath();
      heights.forEach((y, k) => ctx.lineTo(first + k * step, y));
      ctx.stroke();
      ctx.globalAlpha = 1;
      ctx.lineWidth = Math.max(1.5, head / 3);
      ctx.beginPath();
      heights.forEach((y, k) => {
        ctx.moveTo(first + k * step, middle);
        ctx.lineTo(first + k * step, y);
      });
      ctx.stroke();
      ctx.beginPath();
      heights.forEach((y, k) => {
        ctx.moveTo(first + k * step + head, y);
        ctx.arc(first + k * step, y, head, 0, 2 * Math.PI);
      });
      ctx.fill();
      ctx.lineWidth = 2;
      ctx.beginPath();
      part.re.forEach((re, k) => {
        const magnitude = Math.hypot(re, part.im[k]);
        if (magnitude <= 1e-3) return;
        const angle = Math.atan2(part.im[k], re) + phase;
        const length = dial * (0.35 + 0.65 * magnitude);
        ctx.moveTo(first + k * step, hands);
        ctx.lineTo(first + k * step + length * Math.cos(angle), hands - length * Math.sin(angle));
      });
      ctx.stroke();
    }
  }
}

/** The largest displacement, as a fraction of the extent of what is shown. */
const ENLARGED = 0.15;

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => { const size = Math.hypot(...a) || 1; return a.map((value) => value / size); };

/** Rotates vectors: the pad above the disc, the radius from the disc's axis to `centre` as first axis. */
function towards({ axis_point_m: point, axis_direction: axis, normal }, centre) {
  const along = unit(axis);
  // The disc's plane is seen from the side of the pad.
  const up = dot(along, normal) < 0 ? along.map((value) => -value) : along;
  const from = centre.map((value, k) => value - point[k]);
  const away = from.map((value, k) => value - dot(from, along) * along[k]);
  // For a centre on the axis any direction serves.
  const first = unit(Math.hypot(...away) > 1e-9 ? away : cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const second = cross(up, first);
  return (v) => [dot(v, first), dot(v, second), dot(v, up)];
}

/** Without the disc's axis the patch lies flat: its thinnest direction points up. */
function flat(sizes) {
  const up = sizes.indexOf(Math.min(...sizes));
  return (v) => [v[(up + 1) % 3], v[(up + 2) % 3], v[up]];
}

/** Interface nodes in space. */
class Space {
  constructor(three, canvas) {
    this.three = three;
    this.canvas = canvas;
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(32, 1, 0.01, 100);
    this.azimuth = -0.7;
    this.elevation = 0.75;
    canvas.tabIndex = 0;
    const turn = (dx, dy) => {
      this.azimuth += dx;
      this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + dy));
      if (this.last) this.draw(...this.last);
    };
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) turn(-event.movementX * 0.01, event.movementY * 0.01);
    });
    canvas.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (!by) return;
      event.preventDefault();
      turn(...by);
    });
  }

  dispose() {
    this.#clear();
    this.renderer.dispose();
  }

  #clear() {
    this.outline = undefined;
    this.scene.traverse((object) => {
      object.geometry?.dispose();
      object.material?.dispose();
    });
    this.scene.clear();
  }

  take(shape, way = this.way) {
    const spatial = shape.parts.filter((part) => part.spatial && part.nodes_m.length);
    // Most shapes are of the rig that is already drawn.
    const nodes = JSON.stringify([shape.disc, way, spatial.map((part) => part.nodes_m)]);
    if (nodes !== this.nodes) this.#build(spatial, shape.disc, way);
    [this.nodes, this.way] = [nodes, way];
    spatial.forEach((part, p) => {
      const drawn = this.parts[p];
      drawn.part = part;
      drawn.tone.set(colour(part.name === "disc" ? "--disc" : "--pad"));
      drawn.ghost.color.set(colour("--muted"));
    });
    this.outline?.color.set(colour("--disc"));
  }

  /** Draws the parts at rest: nodes, connecting lines, and the outline of the disc if its axis is known. */
  #build(spatial, disc, way) {
    const { three, scene } = this;
    this.#clear();
    const all = spatial.flatMap((part) => part.nodes_m);
    const low = [0, 1, 2].map((axis) => Math.min(...all.map((node) => node[axis])));
    const high = [0, 1, 2].map((axis) => Math.max(...all.map((node) => node[axis])));
    const extent = Math.max(...high.map((value, axis) => value - low[axis]), 1e-9);
    const centre = low.map((value, axis) => (value + high[axis]) / 2);
    this.turned = disc ? towards(disc, centre) : flat(high.map((value, axis) => value - low[axis]));
    // In units of the patch, around its centre; parts in contact are drawn slightly apart.
    const apart = (part) => (spatial.length < 2 ? 0 : part.name === "disc" ? -0.06 : 0.06);
    const place = (node) => this.turned(node.map((value, axis) => (value - centre[axis]) / extent));
    this.parts = spatial.map((part) => {
      const rest = part.nodes_m.map(place).map(([x, y, z]) => [x, y, z + apart(part)]);
      const geometry = new three.BufferGeometry();
      const positions = new three.BufferAttribute(new Float32Array(3 * rest.length), 3);
      const colours = new three.BufferAttribute(new Float32Array(3 * rest.length), 3);
      geometry.setAttribute("position", positions);
      geometry.setAttribute("color", colours);
      const points = new three.Points(geometry, new three.PointsMaterial({ size: 0.05, vertexColors: true }));
      const wire = new three.BufferGeometry();
      wire.setAttribute("position", positions);
      wire.setAttribute("color", colours);
      wire.setIndex(neighbours(rest));
      const lines = new three.LineSegments(wire, new three.LineBasicMaterial({ vertexColors: true }));
      const still = new three.BufferGeometry();
      still.setAttribute("position", new three.BufferAttribute(new Float32Array(rest.flat()), 3));
      still.setIndex(wire.getIndex());
      const ghost = new three.LineBasicMaterial({ transparent: true, opacity: 0.25 });
      for (const object of [new three.LineSegments(still, ghost), lines, points]) {
        object.frustumCulled = false;
        scene.add(object);
      }
      return { rest, positions, colours, ghost, tone: new three.Color() };
    });
    // Positive speed is right-handed about the axis, which may point away from the viewer.
    const sense = disc && dot(disc.axis_direction, disc.normal) < 0 ? -1 : 1;
    if (disc) this.#outline(place(disc.axis_point_m), spatial.findIndex((part) => part.name === "disc"), sense * way);
  }

  /** The edges of the pad's track on the disc, fading with distance from the pad, and the direction of sliding. */
  #outline([ax, ay], k, way) {
    const { three, scene } = this;
    const nodes = this.parts[k < 0 ? 0 : k].rest;
    const radii = nodes.map(([x, y]) => Math.hypot(x - ax, y - ay));
    const angles = nodes.map(([x, y]) => Math.atan2(y - ay, x - ax));
    const z = nodes[0][2];
    const [inner, outer] = [Math.min(...radii), Math.max(...radii)];
    // Nodes all around the axis, or around a middle angle along the first axis of the picture.
    const reach = Math.max(...angles.map(Math.abs));
    const ends = Math.min(Math.PI, reach + Math.max(0.7, 2.5 / outer));
    const at = (radius, angle) => [ax + radius * Math.cos(angle), ay + radius * Math.sin(angle), z];
    const [points, shades] = [[], []];
    const line = (from, to, ...fades) => { points.push(...from, ...to); shades.push(...fades); };
    const fade = (angle) => Math.min(1, Math.max(0, (ends - Math.abs(angle)) / Math.max(1e-9, ends - reach)));
    const full = ends === Math.PI;
    const steps = 96;
    for (const radius of [inner, outer]) {
      for (let i = 0; i < steps; i++) {
        const [from, to] = [i, i + 1].map((n) => ends * (2 * n / steps - 1));
        line(at(radius, from), at(radius, to), full ? 1 : fade(from), full ? 1 : fade(to));
      }
    }
    if (way !== 0 && !full) {
      const [middle, length] = [(inner + outer) / 2, 0.35 / outer];
      const tail = way * (reach + 0.08 / outer);
      const tip = tail + way * length;
      line(at(middle, tail), at(middle, tip), 1, 1);
      for (const side of [-0.07, 0.07]) line(at(middle, tip), at(middle + side, tip - way * 0.3 * length), 1, 1);
    }
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(points), 3));
    geometry.setAttribute("color", new three.BufferAttribute(new Float32Array(shades.flatMap((shade) => [1, 1, 1, shade])), 4));
    this.outline = new three.LineBasicMaterial({ vertexColors: true, transparent: true });
    const lines = new three.LineSegments(geometry, this.outline);
    lines.frustumCulled = false;
    scene.add(lines);
  }

  draw(phase, width, height) {
    this.last = [phase, width, height];
    const { renderer, camera } = this;
    if (this.width !== width || this.height !== height) {
      [this.width, this.height] = [width, height];
      renderer.setPixelRatio(Math.min(2, devicePixelRatio));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    const far = (this.outline ? 2.8 : 2) / Math.min(1, camera.aspect);
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    camera.up.set(0, 0, 1);
    camera.position.set(far * ca * ce, far * sa * ce, far * se);
    camera.lookAt(0, 0, 0);
    const bright = new this.three.Color(colour("--ink"));
    for (const { part, rest, positions, colours, tone } of this.parts) {
      const u = displaced(part.re, part.im, phase);
      const mixed = tone.clone();
      rest.forEach((node, k) => {
        const d = this.turned([u[3 * k], u[3 * k + 1], u[3 * k + 2]]);
        positions.setXYZ(k, ...node.map((value, axis) => value + ENLARGED * d[axis]));
        mixed.copy(tone).lerp(bright, 0.35 * Math.min(1, Math.hypot(...d)));
        colours.setXYZ(k, mixed.r, mixed.g, mixed.b);
      });
      positions.needsUpdate = true;
      colours.needsUpdate = true;
    }
    // For tests and for users who want the numbers: the displacements shown, without scaling.
    this.canvas.displacements = () => this.parts.map(({ rest, positions }) =>
      rest.flatMap((node, k) => node.map((value, axis) => (positions.array[3 * k + axis] - value) / ENLARGED)));
    renderer.render(this.scene, camera);
  }
}

/** Lines from each node to its nearest ones: a net that needs no element connectivity. */
function neighbours(nodes) {
  const pairs = new Set();
  const count = nodes.length;
  const most = count > 1500 ? 3 : 4;
  nodes.forEach((node, k) => {
    const near = [];
    for (let j = 0; j < count; j++) {
      if (j === k) continue;
      const distance = Math.hypot(node[0] - nodes[j][0], node[1] - nodes[j][1], node[2] - nodes[j][2]);
      if (near.length < most || distance < near[near.length - 1][0]) {
        near.push([distance, j]);
        near.sort((a, b) => a[0] - b[0]);
        near.length = Math.min(most, near.length);
      }
    }
    for (const [distance, j] of near) if (distance < 2.5 * near[0][0]) pairs.add(Math.min(k, j) * count + Math.max(k, j));
  });
  return [...pairs].flatMap((pair) => [Math.floor(pair / count), pair % count]);
}
