// Pointer, wheel and keyboard gestures of a viewer, in CSS pixels from its centre. A drag or long press is never
// required: each has an equivalent key or button.

import { clamp } from "../../core/viewport.js";

const DOUBLE_TAP_MS = 300;
const TAP_PX = 30; // maximum distance of the two taps of a double tap
const LONG_PRESS_MS = 500; // Android's own is 400 to 500
const MOVE_TOLERANCE_PX = 12; // movement of a resting finger
const KEY_PX = 60;

/**
 * Gesture recogniser that calls zoomBy, panBy, moveLoupe, placeLoupe, toggleLoupe, doubleTap and showAll of its viewer.
 */
export class Gestures {
  #viewer;
  #pointers = new Map();
  #lastTap = { time: 0, x: 0, y: 0 };
  #longPressTimer = 0;
  #pressStart = { at: [0, 0], time: 0 };
  #loupeHeld = false; // a long press shows the loupe

  constructor(viewer) {
    this.#viewer = viewer;
    const on = (name, handle, options) => viewer.addEventListener(name, (event) => handle(event), options);
    on("wheel", (event) => this.#wheel(event), { passive: false });
    on("pointerdown", (event) => this.#down(event));
    on("pointermove", (event) => this.#move(event));
    on("pointerup", (event) => this.#up(event));
    on("pointercancel", (event) => this.#removePointer(event));
    on("contextmenu", (event) => event.pointerType !== "mouse" && event.preventDefault()); // a long press shows the loupe instead of a menu
    on("keydown", (event) => this.#key(event));
  }

  #fromCentre({ clientX, clientY }) {
    const box = this.#viewer.getBoundingClientRect();
    return [clientX - box.left - box.width / 2, clientY - box.top - box.height / 2];
  }

  #wheel(event) {
    event.preventDefault();
    this.#viewer.zoomBy(Math.exp(-clamp(event.deltaY, -200, 200) / 300), ...this.#fromCentre(event));
  }

  #down(event) {
    this.#viewer.setPointerCapture(event.pointerId);
    const at = this.#fromCentre(event);
    this.#pointers.set(event.pointerId, at);
    clearTimeout(this.#longPressTimer);
    if (this.#pointers.size > 1) return;
    this.#pressStart = { at, time: event.timeStamp };
    this.#longPressTimer = setTimeout(() => this.#holdLoupe(at), LONG_PRESS_MS);
  }

  #holdLoupe(at) {
    if (this.#viewer.hasLoupe) return;
    this.#loupeHeld = true;
    this.#viewer.placeLoupe(at, true);
  }

  #move(event) {
    const from = this.#pointers.get(event.pointerId);
    if (!from) return;
    const to = this.#fromCentre(event);
    if (distance(to, this.#pressStart.at) > MOVE_TOLERANCE_PX) clearTimeout(this.#longPressTimer);
    this.#pointers.set(event.pointerId, to);
    if (this.#loupeHeld) this.#viewer.placeLoupe(to, true);
    else if (this.#pointers.size === 1) this.#drag(to[0] - from[0], to[1] - from[1]);
    else if (this.#pointers.size === 2) this.#pinch(event.pointerId, from, to);
  }

  #drag(x, y) {
    if (this.#viewer.hasLoupe) this.#viewer.moveLoupe(x, y);
    else this.#viewer.panBy(x, y);
  }

  #pinch(id, from, to) {
    const [other] = [...this.#pointers].filter(([pointerId]) => pointerId !== id).map(([, at]) => at);
    const factor = distance(to, other) / distance(from, other);
    this.#viewer.panBy((to[0] - from[0]) / 2, (to[1] - from[1]) / 2);
    if (Number.isFinite(factor)) this.#viewer.zoomBy(factor, (to[0] + other[0]) / 2, (to[1] + other[1]) / 2);
  }

  #up(event) {
    const alone = this.#pointers.size === 1;
    // Event time stamps decide: on a busy tablet the timer may fire before a short tap is delivered.
    const held = this.#removePointer(event) && event.timeStamp - this.#pressStart.time >= LONG_PRESS_MS;
    const [x, y] = this.#fromCentre(event);
    const before = this.#lastTap;
    const still = alone && !held && distance([x, y], this.#pressStart.at) < TAP_PX;
    this.#lastTap = { time: still ? event.timeStamp : 0, x, y };
    if (!still) return;
    if (event.timeStamp - before.time < DOUBLE_TAP_MS && distance([x, y], [before.x, before.y]) < TAP_PX) {
      this.#lastTap.time = 0;
      this.#viewer.doubleTap(x, y);
    } else if (this.#viewer.hasLoupe) {
      this.#viewer.placeLoupe([x, y], false); // a tap moves the loupe too, without a drag
    }
  }

  /** Forget a lifted pointer; return whether it held the loupe. */
  #removePointer(event) {
    clearTimeout(this.#longPressTimer);
    this.#pointers.delete(event.pointerId);
    const wasHeld = this.#loupeHeld;
    if (wasHeld) this.#viewer.hideLoupe();
    this.#loupeHeld = false;
    return wasHeld;
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const viewer = this.#viewer;
    // An arrow key moves the loupe in its direction, or the picture against it.
    const move = (x, y) => (viewer.hasLoupe ? viewer.moveLoupe(-x / 3, -y / 3) : viewer.panBy(x, y));
    const handlers = {
      "+": () => viewer.zoomIn(),
      "=": () => viewer.zoomIn(),
      "-": () => viewer.zoomOut(),
      0: () => viewer.showAll(),
      l: () => viewer.toggleLoupe(),
      ArrowLeft: () => move(KEY_PX, 0),
      ArrowRight: () => move(-KEY_PX, 0),
      ArrowUp: () => move(0, KEY_PX),
      ArrowDown: () => move(0, -KEY_PX),
    };
    const handler = handlers[event.key];
    if (!handler) return;
    event.preventDefault();
    handler();
  }
}

const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
