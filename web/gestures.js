// What fingers, mouse wheel and keys ask of a viewer, in pixels of the page from the viewer's middle. Nothing needs a drag
// or a long press: every move has a key or a button that does the same.

import { clamp } from "./field.js";

const DOUBLE_TAP_MS = 300;
const TAP_PX = 30; // two taps nearer than this are one double tap
const HOLD_MS = 500; // a long press; Android's own is 400 to 500
const STILL_PX = 12; // a finger that rests moves as much
const KEY_PX = 60;

/** Listens on a viewer with the verbs zoomBy, panBy, moveLoupe, placeLoupe, toggleLoupe, doubleTap, showAll. */
export class Gestures {
  #viewer;
  #fingers = new Map();
  #tap = { time: 0, x: 0, y: 0 };
  #hold = 0;
  #began = { at: [0, 0], time: 0 };
  #peeking = false; // a long press holds the loupe under the finger

  constructor(viewer) {
    this.#viewer = viewer;
    const on = (name, react, options) => viewer.addEventListener(name, (event) => react(event), options);
    on("wheel", (event) => this.#wheel(event), { passive: false });
    on("pointerdown", (event) => this.#down(event));
    on("pointermove", (event) => this.#move(event));
    on("pointerup", (event) => this.#up(event));
    on("pointercancel", (event) => this.#gone(event));
    on("contextmenu", (event) => event.pointerType !== "mouse" && event.preventDefault()); // a long press is the loupe
    on("keydown", (event) => this.#key(event));
  }

  #fromMiddle({ clientX, clientY }) {
    const box = this.#viewer.getBoundingClientRect();
    return [clientX - box.left - box.width / 2, clientY - box.top - box.height / 2];
  }

  #wheel(event) {
    event.preventDefault();
    this.#viewer.zoomBy(Math.exp(-clamp(event.deltaY, -200, 200) / 300), ...this.#fromMiddle(event));
  }

  #down(event) {
    this.#viewer.setPointerCapture(event.pointerId);
    const at = this.#fromMiddle(event);
    this.#fingers.set(event.pointerId, at);
    clearTimeout(this.#hold);
    if (this.#fingers.size > 1) return;
    this.#began = { at, time: event.timeStamp };
    this.#hold = setTimeout(() => this.#peek(at), HOLD_MS);
  }

  #peek(at) {
    if (this.#viewer.hasLoupe) return;
    this.#peeking = true;
    this.#viewer.placeLoupe(at, true);
  }

  #move(event) {
    const was = this.#fingers.get(event.pointerId);
    if (!was) return;
    const is = this.#fromMiddle(event);
    if (distance(is, this.#began.at) > STILL_PX) clearTimeout(this.#hold);
    this.#fingers.set(event.pointerId, is);
    if (this.#peeking) this.#viewer.placeLoupe(is, true);
    else if (this.#fingers.size === 1) this.#drag(is[0] - was[0], is[1] - was[1]);
    else if (this.#fingers.size === 2) this.#pinch(event.pointerId, was, is);
  }

  #drag(x, y) {
    if (this.#viewer.hasLoupe) this.#viewer.moveLoupe(x, y);
    else this.#viewer.panBy(x, y);
  }

  #pinch(id, was, is) {
    const [, other] = [...this.#fingers].find(([one]) => one !== id);
    const factor = distance(is, other) / distance(was, other);
    this.#viewer.panBy((is[0] - was[0]) / 2, (is[1] - was[1]) / 2);
    if (Number.isFinite(factor)) this.#viewer.zoomBy(factor, (is[0] + other[0]) / 2, (is[1] + other[1]) / 2);
  }

  #up(event) {
    const alone = this.#fingers.size === 1;
    // The finger's own time counts: on a busy tablet the loupe's clock may run out before a short tap is heard of.
    const held = this.#gone(event) && event.timeStamp - this.#began.time >= HOLD_MS;
    const [x, y] = this.#fromMiddle(event);
    const before = this.#tap;
    const still = alone && !held && distance([x, y], this.#began.at) < TAP_PX;
    this.#tap = { time: still ? event.timeStamp : 0, x, y };
    if (!still) return;
    if (event.timeStamp - before.time < DOUBLE_TAP_MS && distance([x, y], [before.x, before.y]) < TAP_PX) {
      this.#tap.time = 0;
      this.#viewer.doubleTap(x, y);
    } else if (this.#viewer.hasLoupe) {
      this.#viewer.placeLoupe([x, y], false); // where no drag is possible, a tap moves it too
    }
  }

  /** A finger left the glass; whether it had held the loupe. */
  #gone(event) {
    clearTimeout(this.#hold);
    this.#fingers.delete(event.pointerId);
    const peeked = this.#peeking;
    if (peeked) this.#viewer.liftLoupe();
    this.#peeking = false;
    return peeked;
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const viewer = this.#viewer;
    // An arrow shows what lies there: the loupe goes that way, or the picture the other way.
    const go = (x, y) => (viewer.hasLoupe ? viewer.moveLoupe(-x / 3, -y / 3) : viewer.panBy(x, y));
    const acts = {
      "+": () => viewer.zoomIn(),
      "=": () => viewer.zoomIn(),
      "-": () => viewer.zoomOut(),
      0: () => viewer.showAll(),
      l: () => viewer.toggleLoupe(),
      ArrowLeft: () => go(KEY_PX, 0),
      ArrowRight: () => go(-KEY_PX, 0),
      ArrowUp: () => go(0, KEY_PX),
      ArrowDown: () => go(0, -KEY_PX),
    };
    const act = acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }
}

const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
