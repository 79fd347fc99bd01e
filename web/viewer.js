// <eye-pic>: one picture with zoom, pan, loupe, red-free, brightness and contrast. Fingers and keys stand in gestures.js;
// what the tools make of the pixels comes from the page's painter (painter.js); here the result is put on the glass.
// Light DOM, so that the page's style sheet and tests see everything. Loaded when a picture is looked at, not before.

import { getBitmap } from "./api.js";
import { clamp, fitCanvas, homeBox } from "./field.js";
import { Gestures } from "./gestures.js";
import { lens, place } from "./glass.js";
import { studio } from "./painter.js";
import { NEUTRAL } from "./tone.js";

const ZOOM_MAX = 8;
const DOUBLE_TAP_ZOOM = 3;
const STEP = 1.5;
const FADE_MS = 200;
const ALL = Object.freeze({ zoom: 1, u: 0, v: 0, loupe: null });
const SET_EARLY = ["view", "subject", "src", "head", "redfree", "brightness", "contrast", "loupe"];

export class EyePic extends HTMLElement {
  #src = null;
  #subject = null;
  #head = null;
  #tools = NEUTRAL;
  #bitmap = null;
  #mark = "";
  #before = null; // the picture that was shown before, while it fades
  #fadeFrom = 0;
  #loading = new AbortController(); // of this subject: its quick look and its final picture
  #frame = 0;
  // Places are fractions of the picture's width from its middle, so that they survive a sharper picture.
  #view = ALL; // with the loupe's place {u, v, held}, or null; `held` by a long press
  #canvas = document.createElement("canvas");
  #anew = () => this.#redraw();

  constructor() {
    super();
    new Gestures(this);
    new ResizeObserver(this.#anew).observe(this);
    this.#canvas.addEventListener("contextrestored", this.#anew);
  }

  connectedCallback() {
    this.tabIndex = 0;
    this.setAttribute("role", "img");
    this.append(this.#canvas);
    studio().addEventListener("changed", this.#anew);
    document.addEventListener("visibilitychange", this.#anew);
    for (const name of SET_EARLY.filter((one) => Object.hasOwn(this, one))) {
      const value = this[name]; // the page set it before this file was there
      delete this[name];
      this[name] = value;
    }
    this.#note();
    this.#redraw();
  }

  disconnectedCallback() {
    studio().removeEventListener("changed", this.#anew);
    document.removeEventListener("visibilitychange", this.#anew);
    this.#clear();
  }

  /** The page's painter, for who wants to know. */
  static get painter() {
    return studio().painter;
  }

  /** Where another viewer looks, so that two pictures are seen with one zoom and one loupe: {zoom, u, v, loupe}. */
  set view({ zoom, u, v, loupe }) {
    this.#look({ zoom, u, v, loupe: loupe ?? null }, false);
  }

  /** Whose picture this is; another subject begins with the whole picture, the same one keeps the view. */
  set subject(name) {
    if (name === this.#subject) return;
    this.#subject = name;
    this.#clear();
    this.showAll();
  }

  /** {url or blob, mark: "quick" | "final"} or null. The mark becomes visible with its pixels, never before them. */
  set src(src) {
    if (src?.url === this.#src?.url && src?.blob === this.#src?.blob) return;
    if (!src) this.#clear();
    this.#src = src;
    if (src) this.#load(src);
  }

  set head(head) {
    this.#head = head;
    this.#redraw();
  }

  set redfree(redfree) {
    this.#use({ redfree });
  }

  set brightness(brightness) {
    this.#use({ brightness });
  }

  set contrast(contrast) {
    this.#use({ contrast });
  }

  /** Whether the loupe stands in the picture, to be moved by drag, tap or arrow keys. */
  set loupe(on) {
    if (Boolean(on) === this.hasLoupe) return;
    const { u, v } = this.#view;
    this.#look({ loupe: on ? { u, v, held: false } : null });
  }

  get hasLoupe() {
    return Boolean(this.#view.loupe && !this.#view.loupe.held);
  }

  zoomIn() {
    this.zoomBy(STEP);
  }

  zoomOut() {
    this.zoomBy(1 / STEP);
  }

  showAll() {
    const { loupe } = this.#view;
    this.#view = { ...ALL, loupe: loupe && { ...loupe, u: 0, v: 0 } };
    this.#changed();
  }

  // ---- pictures and tools

  async #load({ url, blob, mark }) {
    const { signal } = this.#loading;
    try {
      const bitmap = await (blob ? createImageBitmap(blob) : getBitmap(url, signal));
      // On a slow link the small quick look still comes first, and is welcome; after the final picture it is not.
      if (signal.aborted || (mark === "quick" && this.#mark === "final")) return;
      this.#take(bitmap, mark);
      const grey = studio().isGrey(bitmap);
      this.dispatchEvent(new CustomEvent("drawn", { detail: { url, mark, grey } }));
    } catch {
      if (!signal.aborted) this.dispatchEvent(new CustomEvent("fault", { detail: { url, mark } }));
    }
  }

  #take(bitmap, mark) {
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.#drop(this.#before);
    this.#before = this.#bitmap;
    this.#fadeFrom = bitmap && !calm ? performance.now() : -Infinity;
    this.#bitmap = bitmap;
    this.#mark = mark;
    this.dataset.drawn = ""; // what is on the glass and will stay: written when it is
    this.#note();
    this.#redraw();
  }

  #drop(bitmap) {
    if (!bitmap) return;
    studio().release(bitmap);
    bitmap.close();
  }

  #clear() {
    this.#loading.abort();
    this.#loading = new AbortController();
    this.#src = null;
    for (const bitmap of [this.#before, this.#bitmap]) this.#drop(bitmap);
    this.#before = this.#bitmap = null;
    this.#take(null, "");
  }

  #use(more) {
    this.#tools = { ...this.#tools, ...more };
    this.#redraw();
  }

  // ---- drawing

  #redraw() {
    if (!this.#frame) this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#frame = 0;
    if (document.hidden || !fitCanvas(this.#canvas)) return; // drawn when somebody looks
    const context = this.#canvas.getContext("2d", { alpha: false });
    context.fillStyle = "#000";
    context.fillRect(0, 0, this.#canvas.width, this.#canvas.height);
    if (!this.#bitmap) return;
    const fade = this.#before ? clamp((performance.now() - this.#fadeFrom) / FADE_MS, 0, 1) : 1;
    if (fade < 1) this.#paint(context, this.#before);
    context.globalAlpha = fade;
    this.#paint(context, this.#bitmap);
    context.globalAlpha = 1;
    this.dataset.painter = EyePic.painter.name;
    if (fade < 1) return this.#redraw();
    this.#drop(this.#before);
    this.#before = null;
    const { redfree, brightness, contrast } = this.#tools;
    this.dataset.drawn = `${this.#mark} ${redfree ? "red-free" : "colour"} ${brightness} ${contrast}`;
  }

  #paint(context, bitmap) {
    const { zoom, u, v, loupe } = this.#view;
    const { width, height } = this.#bitmap; // a quick look may be smaller: it fills the place of the final picture
    const scale = this.#baseScale() * zoom;
    const shown = studio().develop(bitmap, this.#tools);
    place(context, shown, { u, v, width: width * scale, height: height * scale });
    if (loupe) lens(context, shown, { u, v, width: width * scale, height: height * scale, loupe });
  }

  /** Canvas pixels per picture pixel at zoom 1. */
  #baseScale() {
    const home = homeBox(this.#head, this.#bitmap.width, this.#bitmap.height);
    return Math.min(this.#canvas.width / home.width, this.#canvas.height / home.height);
  }

  // What a test or a screen reader may want to know stands on the element itself.
  #note() {
    const { zoom, loupe } = this.#view;
    this.dataset.zoom = zoom.toFixed(2);
    this.dataset.mark = this.#mark;
    this.dataset.loupe = loupe ? `${loupe.u.toFixed(3)},${loupe.v.toFixed(3)}` : "";
    this.dispatchEvent(new CustomEvent("zoomed", { detail: zoom }));
  }

  // ---- view

  #changed(tell = true) {
    this.#note();
    this.#redraw();
    if (tell) this.dispatchEvent(new CustomEvent("looked", { detail: this.#view }));
  }

  /** Change the view as far as there is picture. */
  #look(more, tell = true) {
    if (!this.#bitmap) return;
    const wish = { ...this.#view, ...more };
    const { width, height } = this.#bitmap;
    const home = homeBox(this.#head, width, height);
    const zoom = clamp(wish.zoom, 1, ZOOM_MAX);
    const scale = this.#baseScale() * zoom;
    const [seenU, seenV] = [this.#canvas.width, this.#canvas.height].map((size) => size / scale / width / 2);
    const roomU = Math.max(0, home.width / width / 2 - seenU);
    const roomV = Math.max(0, home.height / width / 2 - seenV);
    const u = clamp(wish.u, -roomU, roomU);
    const v = clamp(wish.v, -roomV, roomV);
    const loupe = wish.loupe && {
      held: wish.loupe.held,
      u: clamp(wish.loupe.u, u - seenU, u + seenU),
      v: clamp(wish.loupe.v, v - seenV, v + seenV),
    };
    this.#view = { zoom, u, v, loupe };
    this.#changed(tell);
  }

  /** Zoom so that the picture point under (x, y), in CSS pixels from the middle, stays where it is. */
  zoomBy(factor, x = 0, y = 0) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const next = clamp(zoom * factor, 1, ZOOM_MAX);
    const perPixel = this.#perCssPixel();
    this.#look({ zoom: next, u: u + (x / zoom - x / next) * perPixel, v: v + (y / zoom - y / next) * perPixel });
  }

  panBy(x, y) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const perPixel = this.#perCssPixel() / zoom;
    this.#look({ u: u - x * perPixel, v: v - y * perPixel });
  }

  doubleTap(x, y) {
    if (this.#view.zoom > 1.01) this.showAll();
    else this.zoomBy(DOUBLE_TAP_ZOOM, x, y);
  }

  /** Move the loupe; at the edge of what is seen the picture follows. */
  moveLoupe(x, y) {
    const { zoom, u, v, loupe } = this.#view;
    if (!this.#bitmap || !loupe) return;
    const perPixel = this.#perCssPixel() / zoom;
    const wish = { ...loupe, u: loupe.u + x * perPixel, v: loupe.v + y * perPixel };
    this.#look({ loupe: wish });
    const got = this.#view.loupe;
    this.#look({ u: u + wish.u - got.u, v: v + wish.v - got.v, loupe: wish });
  }

  /** Put the loupe at a point, in CSS pixels from the middle; `held`: as long as a finger stays there. */
  placeLoupe([x, y], held) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const perPixel = this.#perCssPixel() / zoom;
    this.#look({ loupe: { u: u + x * perPixel, v: v + y * perPixel, held } });
  }

  liftLoupe() {
    this.#look({ loupe: null });
  }

  toggleLoupe() {
    this.loupe = !this.hasLoupe;
    this.dispatchEvent(new CustomEvent("loupe", { detail: this.hasLoupe }));
  }

  /** Fractions of the picture's width per CSS pixel at zoom 1. */
  #perCssPixel() {
    return this.#canvas.width / this.#canvas.clientWidth / this.#baseScale() / this.#bitmap.width;
  }
}

customElements.define("eye-pic", EyePic);
