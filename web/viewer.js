// <eye-pic>: one picture with zoom, pan, red-free and contrast, drawn on a 2D canvas with a look-up table.
// Light DOM, so that the page's style sheet and tests see everything. WebGL may come later beside this path, never
// instead of it: cheap tablets' graphics chips cannot always be believed.

import { getBitmap } from "./api.js";

const ZOOM_MAX = 8;
const DOUBLE_TAP_MS = 300;
const DOUBLE_TAP_PX = 30;
const DOUBLE_TAP_ZOOM = 3;
const STEP = 1.5;
const FADE_MS = 200;
const TABLE_SIDE_MAX = 2048; // adjusted copies are limited to this side, so that a tool answers within 100 ms
const CONTRAST_MAX = 5;
const MARGIN = 1.06; // black rim around the illuminated disc

/**
 * The part of a picture (in its own pixels, around its centre) that is shown at zoom 1: the square around the
 * illuminated disc, or everything when the disc is not known or the picture is not a scaled whole frame.
 * @param {{shape?: number[], field_px?: number|null}|null} head
 */
export function homeBox(head, width, height) {
  if (head?.field_px && head.shape) {
    const [rows, cols] = head.shape;
    const scale = width / cols;
    if (Math.abs(height / (rows * scale) - 1) < 0.02) {
      const side = head.field_px * scale * MARGIN;
      return { width: Math.min(side, width), height: Math.min(side, height), disc: head.field_px * scale };
    }
  }
  return { width, height, disc: Math.min(width, height) };
}

/** Make a canvas as many pixels as it covers on the glass; false when nothing is to be seen. */
export function fitCanvas(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2); // beyond 2 the eye gains nothing and the chip pays
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return width > 0 && height > 0;
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

export class EyePic extends HTMLElement {
  #src = null;
  #subject = null;
  #head = null;
  #redfree = false;
  #contrast = 0;
  #bitmap = null;
  #mark = "";
  #shown = null; // what is drawn: the bitmap itself, or its copy through the look-up table
  #before = null; // what was drawn before, while it fades
  #fadeFrom = 0;
  #pixels = null;
  #loading = new AbortController(); // of this subject: its quick look and its final picture
  #frame = 0;
  #view = { zoom: 1, u: 0, v: 0 }; // centre as a fraction of the picture's width, so that it survives a sharper picture
  #fingers = new Map();
  #tap = { time: 0, x: 0, y: 0 };
  #canvas = document.createElement("canvas");

  connectedCallback() {
    if (this.#canvas.isConnected) return;
    this.tabIndex = 0;
    this.setAttribute("role", "img");
    this.append(this.#canvas);
    new ResizeObserver(() => this.#redraw()).observe(this);
    this.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    this.addEventListener("pointerdown", (event) => this.#down(event));
    this.addEventListener("pointermove", (event) => this.#move(event));
    this.addEventListener("pointerup", (event) => this.#up(event));
    this.addEventListener("pointercancel", (event) => this.#fingers.delete(event.pointerId));
    this.addEventListener("keydown", (event) => this.#key(event));
    this.#note();
  }

  /** Where another viewer looks, so that two pictures are seen with one zoom: {zoom, u, v}. */
  set view({ zoom, u, v }) {
    this.#look(zoom, u, v, false);
  }

  /** Whose picture this is; another subject begins with the whole picture, the same one keeps the view. */
  set subject(name) {
    if (name === this.#subject) return;
    this.#subject = name;
    this.#clear();
    this.showAll();
  }

  /** {url, mark: "quick" | "final"} or null. The mark becomes visible with its pixels, never before them. */
  set src(src) {
    if (src?.url === this.#src?.url) return;
    if (!src) this.#clear();
    this.#src = src;
    if (src) this.#load(src);
  }

  #clear() {
    this.#loading.abort();
    this.#loading = new AbortController();
    this.#src = null;
    this.#take(null, "");
  }

  set head(head) {
    this.#head = head;
    this.#redraw();
  }

  set redfree(on) {
    if (on === this.#redfree) return;
    this.#redfree = on;
    this.#develop();
  }

  set contrast(steps) {
    if (steps === this.#contrast) return;
    this.#contrast = steps;
    this.#develop();
  }

  static clampContrast(steps) {
    return clamp(steps, -CONTRAST_MAX, CONTRAST_MAX);
  }

  zoomIn() {
    this.#zoomBy(STEP);
  }

  zoomOut() {
    this.#zoomBy(1 / STEP);
  }

  showAll() {
    this.#view = { zoom: 1, u: 0, v: 0 };
    this.#note();
    this.#redraw();
    this.dispatchEvent(new CustomEvent("looked", { detail: { ...this.#view } }));
  }

  async #load({ url, mark }) {
    const { signal } = this.#loading;
    try {
      const bitmap = await getBitmap(url, signal);
      // On a slow link the small quick look still comes first, and is welcome; after the final picture it is not.
      if (signal.aborted || (mark === "quick" && this.#mark === "final")) return;
      this.#take(bitmap, mark);
      this.dispatchEvent(new CustomEvent("drawn", { detail: { url, mark, grey: this.#isGrey() } }));
    } catch {
      if (!signal.aborted) this.dispatchEvent(new CustomEvent("fault", { detail: { url, mark } }));
    }
  }

  #take(bitmap, mark) {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.#before = bitmap && !calm ? this.#shown : null;
    this.#fadeFrom = performance.now();
    this.#bitmap = bitmap;
    this.#pixels = null;
    this.#mark = mark;
    this.#note();
    this.#develop();
  }

  // ---- tone

  #readPixels() {
    if (this.#pixels || !this.#bitmap) return this.#pixels;
    const { width, height } = this.#bitmap;
    const scale = Math.min(1, TABLE_SIDE_MAX / Math.max(width, height));
    const canvas = document.createElement("canvas");
    Object.assign(canvas, { width: Math.round(width * scale), height: Math.round(height * scale) });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(this.#bitmap, 0, 0, canvas.width, canvas.height);
    this.#pixels = context.getImageData(0, 0, canvas.width, canvas.height);
    return this.#pixels;
  }

  #isGrey() {
    const { data } = this.#readPixels();
    for (let i = 0; i < data.length; i += 4 * 97) {
      if (Math.abs(data[i] - data[i + 1]) > 8 || Math.abs(data[i + 2] - data[i + 1]) > 8) return false;
    }
    return true;
  }

  // Contrast turns about the mean of what is lit, so that a dark retina neither drowns nor burns out.
  #table(data) {
    let sum = 0;
    let count = 1;
    for (let i = 1; i < data.length; i += 4 * 31) {
      if (data[i] > 12) {
        sum += data[i];
        count += 1;
      }
    }
    const pivot = sum / count;
    const gain = 1.25 ** this.#contrast;
    return Uint8ClampedArray.from({ length: 256 }, (_, value) => pivot + (value - pivot) * gain);
  }

  #develop() {
    this.#shown = this.#bitmap;
    if (this.#bitmap && (this.#redfree || this.#contrast)) {
      const from = this.#readPixels();
      const table = this.#table(from.data);
      const to = new ImageData(from.width, from.height);
      const source = from.data;
      const target = to.data;
      for (let i = 0; i < source.length; i += 4) {
        target[i + 1] = table[source[i + 1]];
        target[i] = this.#redfree ? target[i + 1] : table[source[i]];
        target[i + 2] = this.#redfree ? target[i + 1] : table[source[i + 2]];
        target[i + 3] = 255;
      }
      this.#shown = document.createElement("canvas");
      Object.assign(this.#shown, { width: from.width, height: from.height });
      this.#shown.getContext("2d").putImageData(to, 0, 0);
    }
    this.#redraw();
  }

  // ---- drawing

  #redraw() {
    if (!this.#frame) this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#frame = 0;
    if (!fitCanvas(this.#canvas)) return;
    const context = this.#canvas.getContext("2d");
    context.fillStyle = "#000";
    context.fillRect(0, 0, this.#canvas.width, this.#canvas.height);
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const scale = this.#baseScale() * zoom;
    const { width, height } = this.#bitmap;
    const left = this.#canvas.width / 2 - (width / 2 + u * width) * scale;
    const top = this.#canvas.height / 2 - (height / 2 + v * width) * scale;
    const fade = this.#before ? clamp((performance.now() - this.#fadeFrom) / FADE_MS, 0, 1) : 1;
    context.imageSmoothingQuality = "high";
    if (fade < 1) context.drawImage(this.#before, left, top, width * scale, height * scale);
    context.globalAlpha = fade;
    context.drawImage(this.#shown, left, top, width * scale, height * scale);
    context.globalAlpha = 1;
    if (fade < 1) this.#redraw();
    else this.#before = null;
  }

  /** Canvas pixels per picture pixel at zoom 1. */
  #baseScale() {
    const home = homeBox(this.#head, this.#bitmap.width, this.#bitmap.height);
    return Math.min(this.#canvas.width / home.width, this.#canvas.height / home.height);
  }

  // What a test or a screen reader may want to know stands on the element itself.
  #note() {
    this.dataset.zoom = this.#view.zoom.toFixed(2);
    this.dataset.mark = this.#mark;
    this.dispatchEvent(new CustomEvent("zoomed", { detail: this.#view.zoom }));
  }

  // ---- view

  /** Put the view at `zoom` with the centre at (u, v), as far as there is picture. */
  #look(zoom, u, v, tell = true) {
    if (!this.#bitmap) return;
    zoom = clamp(zoom, 1, ZOOM_MAX);
    const { width, height } = this.#bitmap;
    const home = homeBox(this.#head, width, height);
    const scale = this.#baseScale() * zoom;
    const roomU = Math.max(0, home.width / 2 - this.#canvas.width / scale / 2) / width;
    const roomV = Math.max(0, home.height / 2 - this.#canvas.height / scale / 2) / width;
    this.#view = { zoom, u: clamp(u, -roomU, roomU), v: clamp(v, -roomV, roomV) };
    this.#note();
    this.#redraw();
    if (tell) this.dispatchEvent(new CustomEvent("looked", { detail: { ...this.#view } }));
  }

  /** Zoom so that the picture point under (x, y), in CSS pixels from the middle, stays where it is. */
  #zoomBy(factor, x = 0, y = 0) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const next = clamp(zoom * factor, 1, ZOOM_MAX);
    const perPixel = this.#perCssPixel();
    this.#look(next, u + (x / zoom - x / next) * perPixel, v + (y / zoom - y / next) * perPixel);
  }

  #panBy(x, y) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const perPixel = this.#perCssPixel() / zoom;
    this.#look(zoom, u - x * perPixel, v - y * perPixel);
  }

  #perCssPixel() {
    return this.#canvas.width / this.#canvas.clientWidth / this.#baseScale() / this.#bitmap.width;
  }

  #fromMiddle({ clientX, clientY }) {
    const box = this.getBoundingClientRect();
    return [clientX - box.left - box.width / 2, clientY - box.top - box.height / 2];
  }

  // ---- fingers, wheel, keys

  #wheel(event) {
    event.preventDefault();
    this.#zoomBy(Math.exp(-clamp(event.deltaY, -200, 200) / 300), ...this.#fromMiddle(event));
  }

  #down(event) {
    this.setPointerCapture(event.pointerId);
    this.#fingers.set(event.pointerId, this.#fromMiddle(event));
  }

  #move(event) {
    const was = this.#fingers.get(event.pointerId);
    if (!was) return;
    const is = this.#fromMiddle(event);
    if (this.#fingers.size === 1) {
      this.#panBy(is[0] - was[0], is[1] - was[1]);
    } else if (this.#fingers.size === 2) {
      const [, other] = [...this.#fingers].find(([id]) => id !== event.pointerId);
      const factor = Math.hypot(is[0] - other[0], is[1] - other[1]) / Math.hypot(was[0] - other[0], was[1] - other[1]);
      this.#panBy((is[0] - was[0]) / 2, (is[1] - was[1]) / 2);
      if (Number.isFinite(factor)) this.#zoomBy(factor, (is[0] + other[0]) / 2, (is[1] + other[1]) / 2);
    }
    this.#fingers.set(event.pointerId, is);
  }

  #up(event) {
    const alone = this.#fingers.size === 1;
    this.#fingers.delete(event.pointerId);
    const [x, y] = this.#fromMiddle(event);
    const before = this.#tap;
    this.#tap = { time: alone ? event.timeStamp : 0, x, y };
    const quick = event.timeStamp - before.time < DOUBLE_TAP_MS;
    if (!alone || !quick || Math.hypot(x - before.x, y - before.y) > DOUBLE_TAP_PX) return;
    this.#tap.time = 0;
    if (this.#view.zoom > 1.01) this.showAll();
    else this.#zoomBy(DOUBLE_TAP_ZOOM, x, y);
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = 60;
    const acts = {
      "+": () => this.zoomIn(),
      "=": () => this.zoomIn(),
      "-": () => this.zoomOut(),
      0: () => this.showAll(),
      ArrowLeft: () => this.#panBy(step, 0),
      ArrowRight: () => this.#panBy(-step, 0),
      ArrowUp: () => this.#panBy(0, step),
      ArrowDown: () => this.#panBy(0, -step),
    };
    const act = acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}

customElements.define("eye-pic", EyePic);
