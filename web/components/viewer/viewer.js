// <eye-pic>: picture viewer with zoom, pan, loupe, red-free, brightness and contrast. Gestures: gestures.js; tools:
// renderer.js; drawing: canvas.js. Light DOM, so that style sheet and tests reach its parts. Loaded on demand.

import { getPicture } from "../../core/api.js";
import { clamp, context2d, fitCanvas, homeBox } from "../../core/viewport.js";
import { Gestures } from "./gestures.js";
import { drawLoupe, drawOverview, drawPicture } from "./canvas.js";
import { pictureRenderer } from "./renderer.js";
import { NEUTRAL } from "./lookup_table.js";
import { t } from "../../i18n/translate.js";

const ZOOM_MAX = 8;
const DOUBLE_TAP_ZOOM = 3;
const OVERVIEW_MIN_ZOOM = 2; // from here on, a small whole picture shows which part is seen
const STEP = 1.5;
const FADE_MS = 200;
const RETRY_MIN_MS = 1000; // a picture that failed to load is requested again, each time after twice the wait
const RETRY_MAX_MS = 15_000;
const WHOLE_VIEW = Object.freeze({ zoom: 1, u: 0, v: 0, loupe: null });
const EARLY_PROPERTIES = ["view", "subject", "src", "head", "redfree", "brightness", "contrast", "loupe"];

/** Custom element <eye-pic>; dispatches "drawn", "fault", "zoomed", "looked" and "loupe". */
export class PictureViewer extends HTMLElement {
  /** @type {{url?: string, blob?: Blob, mark: string, redfree?: boolean} | null} */
  #src = null;
  /** @type {string | null} */
  #subject = null;
  #head = null;
  #tools = NEUTRAL;
  /** @type {ImageBitmap | null} */
  #bitmap = null;
  #mark = "";
  #takenRedfree = false; // the picture itself is in green light only
  /** @type {ImageBitmap | null} */
  #previous = null; // the previous picture during the fade
  #fadeStartMs = 0;
  #loading = new AbortController(); // pending requests of this subject
  #frame = 0;
  // Positions are fractions of the picture width from the centre, independent of its resolution.
  /** @type {{zoom: number, u: number, v: number, loupe: {u: number, v: number, held: boolean} | null}} */
  #view = WHOLE_VIEW; // loupe: {u, v, held} or null; `held` during a long press
  #canvas = document.createElement("canvas");
  #message = document.createElement("p"); // why there is no picture yet
  #onChange = () => this.#redraw();

  constructor() {
    super();
    new Gestures(this);
    new ResizeObserver(this.#onChange).observe(this);
    this.#canvas.addEventListener("contextrestored", this.#onChange);
  }

  connectedCallback() {
    this.tabIndex = 0;
    this.setAttribute("role", "img");
    this.#message.className = "age";
    this.#message.hidden = true;
    this.append(this.#canvas, this.#message);
    pictureRenderer().addEventListener("changed", this.#onChange);
    document.addEventListener("visibilitychange", this.#onChange);
    for (const name of EARLY_PROPERTIES.filter((property) => Object.hasOwn(this, property))) {
      const value = this[name]; // set by the page before this module was loaded
      delete this[name];
      this[name] = value;
    }
    this.#publishState();
    this.#redraw();
  }

  disconnectedCallback() {
    pictureRenderer().removeEventListener("changed", this.#onChange);
    document.removeEventListener("visibilitychange", this.#onChange);
    this.#clear();
  }

  /** The page's renderer, for diagnostics. */
  static get renderer() {
    return pictureRenderer().renderer;
  }

  /** The view of another viewer, for synchronised zoom and loupe: {zoom, u, v, loupe}. */
  set view({ zoom, u, v, loupe }) {
    this.#setView({ zoom, u, v, loupe: loupe ?? null }, false);
  }

  /** Identity of the picture: a new subject resets the view, the same one keeps it. */
  set subject(name) {
    if (name === this.#subject) return;
    this.#subject = name;
    this.#clear();
    this.showAll();
  }

  /** {url or blob, mark: "quick" | "final", redfree} or null. The mark is published after its pixels are drawn. */
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
    this.#setTools({ redfree });
  }

  set brightness(brightness) {
    this.#setTools({ brightness });
  }

  set contrast(contrast) {
    this.#setTools({ contrast });
  }

  /** Whether the loupe is shown; drag, tap and arrow keys move it. */
  set loupe(on) {
    if (Boolean(on) === this.hasLoupe) return;
    const { u, v } = this.#view;
    this.#setView({ loupe: on ? { u, v, held: false } : null });
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
    this.#view = { ...WHOLE_VIEW, loupe: loupe && { ...loupe, u: 0, v: 0 } };
    this.#viewChanged();
  }

  // ---- picture and tools

  async #load(src, waitMs = RETRY_MIN_MS) {
    const { url, blob, mark } = src;
    const { signal } = this.#loading;
    try {
      const bitmap = await createImageBitmap(blob ?? (await getPicture(url, signal)));
      // The quick look is shown only until the final picture is loaded, a final picture only while it is selected.
      const isLate = mark === "quick" ? this.#mark === "final" : src !== this.#src;
      if (signal.aborted || isLate) return;
      this.#show(bitmap, src);
      const grey = pictureRenderer().isGrey(bitmap);
      this.dispatchEvent(new CustomEvent("drawn", { detail: { url, mark, grey } }));
    } catch (problem) {
      if (signal.aborted || src !== this.#src) return;
      if (problem instanceof TypeError) this.#loadLater(src, waitMs);
      else this.dispatchEvent(new CustomEvent("fault", { detail: { url, mark } }));
    }
  }

  // No answer, or an error of the server: say so and request the picture again, until another one is selected.
  #loadLater(src, waitMs) {
    const { signal } = this.#loading;
    this.#message.textContent = t("fault.picture.retry");
    this.#message.hidden = false;
    setTimeout(() => {
      if (!signal.aborted && src === this.#src) this.#load(src, Math.min(2 * waitMs, RETRY_MAX_MS));
    }, waitMs);
  }

  /**
   * @param {ImageBitmap | null} bitmap
   * @param {{mark: string, redfree?: boolean}} src
   */
  #show(bitmap, { mark, redfree }) {
    const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.#releaseBitmap(this.#previous);
    this.#previous = this.#bitmap;
    this.#fadeStartMs = bitmap && !reducedMotion ? performance.now() : -Infinity;
    this.#bitmap = bitmap;
    this.#message.hidden = true;
    this.#mark = mark;
    this.#takenRedfree = Boolean(redfree);
    this.dataset.drawn = ""; // written after the final draw
    this.#publishState();
    this.#redraw();
  }

  /** @param {ImageBitmap | null} bitmap */
  #releaseBitmap(bitmap) {
    if (!bitmap) return;
    pictureRenderer().release(bitmap);
    bitmap.close();
  }

  #clear() {
    this.#loading.abort();
    this.#loading = new AbortController();
    this.#src = null;
    for (const bitmap of [this.#previous, this.#bitmap]) this.#releaseBitmap(bitmap);
    this.#previous = this.#bitmap = null;
    this.#show(null, { mark: "" });
  }

  #setTools(patch) {
    this.#tools = { ...this.#tools, ...patch };
    this.#redraw();
  }

  // ---- drawing

  #redraw() {
    if (!this.#frame) this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#frame = 0;
    if (document.hidden || !fitCanvas(this.#canvas)) return; // drawn when the page is visible
    const context = context2d(this.#canvas, { alpha: false });
    context.fillStyle = "#000";
    context.fillRect(0, 0, this.#canvas.width, this.#canvas.height);
    if (!this.#bitmap) return;
    const fade = this.#previous ? clamp((performance.now() - this.#fadeStartMs) / FADE_MS, 0, 1) : 1;
    if (fade < 1) this.#drawBitmap(context, this.#previous);
    context.globalAlpha = fade;
    this.#drawBitmap(context, this.#bitmap);
    context.globalAlpha = 1;
    this.dataset.painter = PictureViewer.renderer.name;
    if (fade < 1) return this.#redraw();
    this.#releaseBitmap(this.#previous);
    this.#previous = null;
    const { redfree, brightness, contrast } = this.#tools;
    this.dataset.drawn = `${this.#mark} ${redfree || this.#takenRedfree ? "red-free" : "colour"} ${brightness} ${contrast}`;
  }

  #drawBitmap(context, bitmap) {
    const { zoom, u, v, loupe } = this.#view;
    const { width, height } = this.#bitmap ?? bitmap; // a smaller quick look is scaled to the size of the final picture
    const scale = this.#baseScale(this.#bitmap ?? bitmap) * zoom;
    const shown = pictureRenderer().render(bitmap, this.#tools);
    drawPicture(context, shown, { u, v, width: width * scale, height: height * scale });
    if (loupe) drawLoupe(context, shown, { u, v, width: width * scale, height: height * scale, loupe });
    if (zoom >= OVERVIEW_MIN_ZOOM) {
      const home = homeBox(this.#head, width, height);
      const side = Math.max(home.width, home.height) * scale;
      drawOverview(context, shown, { u, v, width: width * scale, height: height * scale, side });
    }
  }

  /** Canvas pixels per pixel of a picture at zoom 1. */
  #baseScale({ width, height }) {
    const home = homeBox(this.#head, width, height);
    return Math.min(this.#canvas.width / home.width, this.#canvas.height / home.height);
  }

  // Publish the state as data attributes, for tests.
  #publishState() {
    const { zoom, loupe } = this.#view;
    this.dataset.zoom = zoom.toFixed(2);
    this.dataset.mark = this.#mark;
    this.dataset.loupe = loupe ? `${loupe.u.toFixed(3)},${loupe.v.toFixed(3)}` : "";
    this.dispatchEvent(new CustomEvent("zoomed", { detail: zoom }));
  }

  // ---- view

  #viewChanged(notify = true) {
    this.#publishState();
    this.#redraw();
    if (notify) this.dispatchEvent(new CustomEvent("looked", { detail: this.#view }));
  }

  /** Set the view, limited to the picture. */
  #setView(patch, notify = true) {
    if (!this.#bitmap) return;
    const requested = { ...this.#view, ...patch };
    const { width, height } = this.#bitmap;
    const home = homeBox(this.#head, width, height);
    const zoom = clamp(requested.zoom, 1, ZOOM_MAX);
    const scale = this.#baseScale(this.#bitmap) * zoom;
    const [visibleU, visibleV] = [this.#canvas.width, this.#canvas.height].map((size) => size / scale / width / 2);
    const limitU = Math.max(0, home.width / width / 2 - visibleU);
    const limitV = Math.max(0, home.height / width / 2 - visibleV);
    const u = clamp(requested.u, -limitU, limitU);
    const v = clamp(requested.v, -limitV, limitV);
    const loupe = requested.loupe && {
      held: requested.loupe.held,
      u: clamp(requested.loupe.u, u - visibleU, u + visibleU),
      v: clamp(requested.loupe.v, v - visibleV, v + visibleV),
    };
    this.#view = { zoom, u, v, loupe };
    this.#viewChanged(notify);
  }

  /** Zoom about the point (x, y), in CSS pixels from the centre. */
  zoomBy(factor, x = 0, y = 0) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const next = clamp(zoom * factor, 1, ZOOM_MAX);
    const perPixel = this.#perCssPixel(this.#bitmap);
    this.#setView({ zoom: next, u: u + (x / zoom - x / next) * perPixel, v: v + (y / zoom - y / next) * perPixel });
  }

  panBy(x, y) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const perPixel = this.#perCssPixel(this.#bitmap) / zoom;
    this.#setView({ u: u - x * perPixel, v: v - y * perPixel });
  }

  doubleTap(x, y) {
    if (this.#view.zoom > 1.01) this.showAll();
    else this.zoomBy(DOUBLE_TAP_ZOOM, x, y);
  }

  /** Move the loupe; at the edge of the visible part the picture follows. */
  moveLoupe(x, y) {
    const { zoom, u, v, loupe } = this.#view;
    if (!this.#bitmap || !loupe) return;
    const perPixel = this.#perCssPixel(this.#bitmap) / zoom;
    const requested = { ...loupe, u: loupe.u + x * perPixel, v: loupe.v + y * perPixel };
    this.#setView({ loupe: requested });
    const actual = this.#view.loupe ?? requested;
    this.#setView({ u: u + requested.u - actual.u, v: v + requested.v - actual.v, loupe: requested });
  }

  /** Place the loupe at a point, in CSS pixels from the centre; `held` during a long press. */
  placeLoupe([x, y], held) {
    if (!this.#bitmap) return;
    const { zoom, u, v } = this.#view;
    const perPixel = this.#perCssPixel(this.#bitmap) / zoom;
    this.#setView({ loupe: { u: u + x * perPixel, v: v + y * perPixel, held } });
  }

  hideLoupe() {
    this.#setView({ loupe: null });
  }

  toggleLoupe() {
    this.loupe = !this.hasLoupe;
    this.dispatchEvent(new CustomEvent("loupe", { detail: this.hasLoupe }));
  }

  /** Return picture widths per CSS pixel at zoom 1. */
  #perCssPixel(bitmap) {
    return this.#canvas.width / this.#canvas.clientWidth / this.#baseScale(bitmap) / bitmap.width;
  }
}

customElements.define("eye-pic", PictureViewer);

/**
 * Return the viewers in an element.
 * @param {ParentNode} element
 * @returns {NodeListOf<PictureViewer>}
 */
export const viewersOf = (element) => element.querySelectorAll("eye-pic");
