// <eye-live>: live preview. The next frame is requested after the last one is drawn, so a slow connection lowers the
// frame rate and not the freshness (MJPEG lagged 3 s on the same connection).

import { getPreview, ApiError } from "../core/api.js";
import { context2d, fitCanvas, homeBox } from "../core/viewport.js";
import { number, t } from "../i18n/translate.js";

const RETRY_MS = 500;
const RESPONSE_TIMEOUT_MS = 5000; // the server answers "no new frame" after 2 s; a longer wait is a dead connection
const LATE_MS = 1000;
const RING = 0.8; // fraction of the illuminated disc; what lies inside is well within the picture

const delay = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Custom element <eye-live>; dispatches "aim", "late" and "refused". */
export class LivePreview extends HTMLElement {
  #active = false;
  #running = false;
  #head = null;
  #eye = "OD";
  /** @type {string | null} */
  #visit = null; // the visit for which light is allowed
  #link = "opening";
  /** @type {ImageBitmap | null} */
  #bitmap = null;
  #number = 0;
  #takenMs = 0; // on this page's clock: when the drawn frame was exposed
  #answeredMs = 0; // when the server last answered, with a frame or without one
  /** @type {{code: string} | null} */
  #hint = null; // aiming hint
  #reported = { frameS: 0, linkS: 0 };
  #clearedMs = -Infinity; // frames from before this moment are not shown
  #abort = new AbortController();
  #canvas = document.createElement("canvas");
  #age = document.createElement("p");
  #empty = document.createElement("p");

  connectedCallback() {
    if (this.#canvas.isConnected) return;
    this.#canvas.setAttribute("role", "img");
    this.#canvas.setAttribute("aria-label", t("aim.live"));
    this.#age.className = "age";
    this.#empty.className = "empty";
    this.#empty.textContent = this.#visit ? t("aim.waiting") : "";
    this.append(this.#canvas, this.#empty, this.#age);
    new ResizeObserver(() => this.#draw()).observe(this);
    document.addEventListener("visibilitychange", () => this.#poll());
    setInterval(() => this.#updateAge(), 250);
    this.#draw();
    this.#poll();
  }

  /** True while aiming; frames are requested only then. */
  set active(on) {
    if (on === this.#active) return;
    this.#active = on;
    if (on) this.#clearFrame(); // discard the frame from before the last press
    else this.#abort.abort();
    this.#draw();
    this.#poll();
  }

  set head(head) {
    this.#head = head;
    this.#draw();
  }

  /** The eye that gets the light; a change discards the frame of the other one. */
  set eye(eye) {
    if (eye === this.#eye) return;
    this.#eye = eye;
    this.#number = 0;
    this.#abort.abort();
    this.#clearFrame();
    this.#draw();
  }

  /** The visit for which light is allowed, or null; a change discards the shown frame. */
  set visit(visit) {
    if (visit === this.#visit) return;
    this.#visit = visit;
    this.#empty.textContent = visit ? t("aim.waiting") : "";
    this.#clearFrame();
    this.#draw();
  }

  set hint(hint) {
    if (hint === this.#hint) return;
    this.#hint = hint;
    this.#draw();
  }

  /** "opening", "live" or "lost"; after a reconnection, a pending request on the old connection is aborted. */
  set link(link) {
    if (link === "live" && this.#link === "lost") {
      this.#number = 0;
      this.#abort.abort();
    }
    this.#link = link;
  }

  #clearFrame() {
    this.#clearedMs = performance.now();
    this.#bitmap?.close();
    this.#bitmap = null;
    this.#empty.hidden = false;
    delete this.dataset.frame;
    this.#updateAge();
  }

  async #poll() {
    if (this.#running) return;
    this.#running = true;
    while (this.#active && !document.hidden && this.isConnected) await this.#fetchFrame();
    this.#running = false;
  }

  async #fetchFrame() {
    const abort = new AbortController();
    const timeout = setTimeout(() => abort.abort(), RESPONSE_TIMEOUT_MS);
    this.#abort = abort;
    try {
      const frame = await getPreview(this.#number, this.#eye, this.#visit, abort.signal);
      this.#answeredMs = performance.now();
      if (!frame) this.#number = 0; // a restarted server counts from the beginning
      if (abort.signal.aborted) return frame?.bitmap.close(); // of the other eye, or of a dead connection
      if (!frame || !this.#active) return;
      this.#number = frame.number;
      const takenMs = performance.now() - frame.ageMs;
      if (takenMs < this.#clearedMs) return frame.bitmap.close(); // the server's last one, from before aiming
      this.#bitmap?.close();
      this.#bitmap = frame.bitmap;
      this.#takenMs = takenMs;
      this.dataset.frame = String(frame.number);
      this.#empty.hidden = true;
      this.#draw();
      this.#updateAge();
      this.dispatchEvent(new CustomEvent("aim", { detail: frame.aim }));
    } catch (problem) {
      this.#number = 0;
      if (problem instanceof ApiError) this.dispatchEvent(new CustomEvent("refused", { detail: problem }));
      if (!abort.signal.aborted) await delay(RETRY_MS);
    } finally {
      clearTimeout(timeout);
    }
  }

  // Show the age of an old frame: aiming by an old frame is worse than without one.
  #updateAge() {
    const ageMs = performance.now() - this.#takenMs;
    const late = this.#active && this.#bitmap !== null && ageMs > LATE_MS;
    this.#age.hidden = !late;
    this.toggleAttribute("late", late);
    if (late) this.#age.textContent = t("aim.late", { s: number(ageMs / 1000, ageMs < 10000 ? 1 : 0) });
    // Without new frames from the camera the server answers in time: then the connection is not late.
    const unansweredMs = performance.now() - Math.max(this.#takenMs, this.#answeredMs);
    const [frameS, linkS] = [ageMs, unansweredMs].map((ms) => (late ? Math.floor(ms / 1000) : 0));
    const before = this.#reported;
    this.#reported = { frameS, linkS };
    if (frameS !== before.frameS || linkS !== before.linkS) this.dispatchEvent(new CustomEvent("late", { detail: this.#reported }));
  }

  #draw() {
    if (!this.#canvas.isConnected || !fitCanvas(this.#canvas)) return;
    const { width, height } = this.#canvas;
    const context = context2d(this.#canvas);
    context.fillStyle = "#000";
    context.fillRect(0, 0, width, height);
    let disc = Math.min(width, height) * 0.94;
    if (this.#bitmap) {
      const home = homeBox(this.#head, this.#bitmap.width, this.#bitmap.height);
      const scale = Math.min(width / home.width, height / home.height);
      disc = home.disc * scale;
      const [w, h] = [this.#bitmap.width * scale, this.#bitmap.height * scale];
      context.imageSmoothingQuality = "high";
      context.drawImage(this.#bitmap, (width - w) / 2, (height - h) / 2, w, h);
    }
    if (this.#active) drawRing(context, width / 2, height / 2, (disc * RING) / 2, this.#hint?.code);
  }
}

// A dark line under a bright one is visible on any picture. Dashed yellow until "ready", then solid green, so that
// colour is not the only cue. An arrow at the ring shows where to move.
function drawRing(context, x, y, radius, code) {
  const line = Math.max(3, radius / 60);
  const ready = code === "ready";
  context.setLineDash(ready ? [] : [line * 5, line * 3]);
  const strokes = [["rgba(0, 0, 0, 0.6)", line * 2], [ready ? "#6fdd8b" : "#ffd060", line]];
  for (const [colour, wide] of strokes) {
    context.strokeStyle = colour;
    context.lineWidth = wide;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.stroke();
  }
  context.setLineDash([]);
  const turn = { right: 0, down: 90, left: 180, up: 270 }[code];
  if (turn !== undefined) drawArrow(context, x, y, radius, turn, strokes);
}

function drawArrow(context, x, y, radius, turn_deg, strokes) {
  context.save();
  context.translate(x, y);
  context.rotate((turn_deg * Math.PI) / 180);
  for (const [colour, wide] of strokes) {
    context.strokeStyle = colour;
    context.lineWidth = wide * 1.5;
    context.beginPath();
    context.moveTo(radius * 0.86, -radius * 0.14);
    context.lineTo(radius, 0);
    context.lineTo(radius * 0.86, radius * 0.14);
    context.stroke();
  }
  context.restore();
}

customElements.define("eye-live", LivePreview);
