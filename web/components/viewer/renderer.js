// Choice of the renderer: WebGL if it passes its self-test, else the 2-D canvas; both draw equal pictures.
// Interface of a renderer: load(picture) -> handle, draw(handle, tools) -> canvas, release(handle).

import { Renderer2d } from "./renderer_2d.js";
import { WebglError, openWebgl, RendererWebgl } from "./renderer_webgl.js";
import { NEUTRAL, sameTools, downscaled, analyse, lookupTable } from "./lookup_table.js";

const SIDE_MAX = 2048; // supported by every WebGL2 device, and fast enough in JavaScript

/**
 * Renderer of the page with a cache: all viewers share one context. Dispatches "changed" when it falls back to the 2-D
 * canvas.
 */
export class PictureRenderer extends EventTarget {
  /** @type {Map<any, any>} */
  #cache = new Map(); // picture -> analysis, handle, and the last output with its tools
  /** @type {any} */
  #renderer;

  /** `open` returns a WebGL2 context or null. */
  constructor(open = openWebgl) {
    super();
    try {
      this.#renderer = new RendererWebgl(open(), () => this.#useRenderer2d("it went away"));
    } catch (problem) {
      this.#handleError(problem);
    }
    document.addEventListener("visibilitychange", () => document.hidden && this.#clearAll());
  }

  get renderer() {
    return this.#renderer;
  }

  /** Return whether the picture has no colours. */
  isGrey(picture) {
    return this.#entry(picture).analysis.grey;
  }

  /** Return `picture` with the tools applied; the full-resolution picture itself when the tools are neutral. */
  render(picture, tools) {
    if (sameTools(tools, NEUTRAL)) return picture;
    const entry = this.#entry(picture);
    if (entry.tools && sameTools(tools, entry.tools)) return entry.output;
    try {
      entry.handle ??= this.#renderer.load(limitedSize(picture));
      entry.output = this.#renderer.draw(entry.handle, {
        redfree: tools.redfree,
        table: lookupTable(entry.analysis.pivot, tools),
      });
    } catch (problem) {
      this.#handleError(problem);
      return this.render(picture, tools);
    }
    entry.tools = tools;
    return entry.output;
  }

  /** Discard the cache entry of a picture. */
  release(picture) {
    this.#clearEntry(this.#cache.get(picture));
    this.#cache.delete(picture);
  }

  #entry(picture) {
    if (!this.#cache.has(picture)) this.#cache.set(picture, { analysis: analyse(picture) });
    return this.#cache.get(picture);
  }

  #clearEntry(entry) {
    if (entry?.handle) this.#renderer.release(entry.handle);
    if (entry) Object.assign(entry, { handle: undefined, output: undefined, tools: undefined });
  }

  // Free the memory of a hidden page; pictures are rendered again when it is visible.
  #clearAll() {
    for (const entry of this.#cache.values()) this.#clearEntry(entry);
  }

  #handleError(problem) {
    if (!(problem instanceof WebglError)) throw problem;
    this.#useRenderer2d(problem.message);
  }

  #useRenderer2d(reason) {
    if (this.#renderer?.name === "2d") return;
    for (const entry of this.#cache.values()) Object.assign(entry, { handle: undefined, output: undefined, tools: undefined });
    this.#renderer = new Renderer2d();
    console.info(`Pictures are drawn without the graphics chip: ${reason}.`);
    this.dispatchEvent(new Event("changed"));
  }
}

const limitedSize = (picture) =>
  Math.max(picture.width, picture.height) > SIDE_MAX ? downscaled(picture, SIDE_MAX) : picture;

let shared = null;

/** Return the page's renderer; created and self-tested at the first call. */
export const pictureRenderer = () => (shared ??= new PictureRenderer());
