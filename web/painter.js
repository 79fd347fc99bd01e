// Which painter draws: the graphics chip while it can be believed, plain JavaScript otherwise. Who looks sees no difference.
// A painter has three verbs: load(picture) -> plate, draw(plate, tools) -> canvas, release(plate).

import { Painter2d } from "./painter_2d.js";
import { GlFault, openGl, PainterGl } from "./painter_gl.js";
import { NEUTRAL, sameTools, smallCopy, study, toneTable } from "./tone.js";

const SIDE_MAX = 2048; // every chip with WebGL2 takes as much, and JavaScript still answers in time

/** One for the whole page: the pictures that are looked at share its context. Tells "changed" when another painter took over. */
export class Studio extends EventTarget {
  #held = new Map(); // picture -> what is known of it, its plate, and how it was drawn last
  #painter;

  /** `open` gives a WebGL2 context or null. */
  constructor(open = openGl) {
    super();
    try {
      this.#painter = new PainterGl(open(), () => this.#fallBack("it went away"));
    } catch (problem) {
      this.#fallBackFrom(problem);
    }
    document.addEventListener("visibilitychange", () => document.hidden && this.#rest());
  }

  get painter() {
    return this.#painter;
  }

  /** Whether the picture has no colours of its own. */
  isGrey(picture) {
    return this.#about(picture).known.grey;
  }

  /** What is to be drawn for `picture` under `tools`: itself, with every pixel that it has, when no tool is used. */
  develop(picture, tools) {
    if (sameTools(tools, NEUTRAL)) return picture;
    const about = this.#about(picture);
    if (about.tools && sameTools(tools, about.tools)) return about.sheet;
    try {
      about.plate ??= this.#painter.load(fitting(picture));
      about.sheet = this.#painter.draw(about.plate, {
        redfree: tools.redfree,
        table: toneTable(about.known.pivot, tools),
      });
    } catch (problem) {
      this.#fallBackFrom(problem);
      return this.develop(picture, tools);
    }
    about.tools = tools;
    return about.sheet;
  }

  /** Nobody looks at the picture any more. */
  release(picture) {
    this.#putAway(this.#held.get(picture));
    this.#held.delete(picture);
  }

  #about(picture) {
    if (!this.#held.has(picture)) this.#held.set(picture, { known: study(picture) });
    return this.#held.get(picture);
  }

  #putAway(about) {
    if (about?.plate) this.#painter.release(about.plate);
    if (about) Object.assign(about, { plate: undefined, sheet: undefined, tools: undefined });
  }

  // What nobody sees needs no memory: it is drawn anew when the page is looked at again.
  #rest() {
    for (const about of this.#held.values()) this.#putAway(about);
  }

  #fallBackFrom(problem) {
    if (!(problem instanceof GlFault)) throw problem;
    this.#fallBack(problem.message);
  }

  #fallBack(reason) {
    if (this.#painter?.name === "2d") return;
    for (const about of this.#held.values()) Object.assign(about, { plate: undefined, sheet: undefined, tools: undefined });
    this.#painter = new Painter2d();
    console.info(`Pictures are drawn without the graphics chip: ${reason}.`);
    this.dispatchEvent(new Event("changed"));
  }
}

const fitting = (picture) =>
  Math.max(picture.width, picture.height) > SIDE_MAX ? smallCopy(picture, SIDE_MAX) : picture;

let shared = null;

/** The studio of this page; made, and its chip tried, when the first picture comes. */
export const studio = () => (shared ??= new Studio());
