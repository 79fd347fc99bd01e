// <eye-live>: the live preview. It asks for the next frame only when it has drawn the last one, so a slow link makes
// fewer frames and never an old picture (MJPEG was 3 s behind on the same link; knowledge/page.md 3.1).

import { getPreview, Refusal } from "./api.js";
import { fitCanvas, homeBox } from "./field.js";
import { number, t } from "./words.js";

const RETRY_MS = 500;
const ANSWER_MS = 5000; // the server says "nothing new" after 2 s; longer than this is a dead link
const LATE_MS = 1000;
const RING = 0.8; // of the illuminated disc: what lies inside it will be in the picture with room to spare

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export class EyeLive extends HTMLElement {
  #active = false;
  #running = false;
  #head = null;
  #eye = "OD"; // whose light it is
  #visit = null; // for which light is allowed
  #link = "opening";
  #bitmap = null;
  #number = 0;
  #takenAt = 0; // on this page's clock: when the light of the drawn frame was collected
  #hint = null; // what the device says about aiming: {code, fill}
  #told = 0;
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
    document.addEventListener("visibilitychange", () => this.#run());
    setInterval(() => this.#tellAge(), 250);
    this.#draw();
    this.#run();
  }

  /** True while the operator aims: only then are frames asked for. */
  set active(on) {
    if (on === this.#active) return;
    this.#active = on;
    if (on) this.#forget(); // what was seen before the last press is not what is there now
    else this.#abort.abort();
    this.#draw();
    this.#run();
  }

  set head(head) {
    this.#head = head;
    this.#draw();
  }

  set eye(eye) {
    this.#eye = eye;
  }

  /** The visit for which light is allowed, or null: nothing that was seen for another one, or before that, stays. */
  set visit(visit) {
    if (visit === this.#visit) return;
    this.#visit = visit;
    this.#empty.textContent = visit ? t("aim.waiting") : "";
    this.#forget();
    this.#draw();
  }

  set hint(hint) {
    if (hint === this.#hint) return;
    this.#hint = hint;
    this.#draw();
  }

  /** "opening", "live" or "lost": when the link comes back, a request that hangs on the old one is given up at once. */
  set link(link) {
    if (link === "live" && this.#link === "lost") {
      this.#number = 0;
      this.#abort.abort();
    }
    this.#link = link;
  }

  #forget() {
    this.#bitmap?.close();
    this.#bitmap = null;
    this.#empty.hidden = false;
    delete this.dataset.frame;
    this.#tellAge();
  }

  async #run() {
    if (this.#running) return;
    this.#running = true;
    while (this.#active && !document.hidden && this.isConnected) await this.#next();
    this.#running = false;
  }

  async #next() {
    const abort = new AbortController();
    const patience = setTimeout(() => abort.abort(), ANSWER_MS);
    this.#abort = abort;
    try {
      const frame = await getPreview(this.#number, this.#eye, this.#visit, abort.signal);
      if (!frame) this.#number = 0; // perhaps the server started anew while nobody looked, with small numbers
      if (!frame || !this.#active) return;
      this.#bitmap?.close();
      this.#bitmap = frame.bitmap;
      this.#number = frame.number;
      this.#takenAt = performance.now() - frame.ageMs;
      this.dataset.frame = String(frame.number);
      this.#empty.hidden = true;
      this.#draw();
      this.#tellAge();
      this.dispatchEvent(new CustomEvent("aim", { detail: frame.aim }));
    } catch (problem) {
      this.#number = 0;
      if (problem instanceof Refusal) this.dispatchEvent(new CustomEvent("refused", { detail: problem }));
      if (!abort.signal.aborted) await pause(RETRY_MS);
    } finally {
      clearTimeout(patience);
    }
  }

  // A picture that is old must say so: aiming by an old picture is worse than having none.
  #tellAge() {
    const age = performance.now() - this.#takenAt;
    const late = this.#active && this.#bitmap !== null && age > LATE_MS;
    this.#age.hidden = !late;
    this.toggleAttribute("late", late);
    if (late) this.#age.textContent = t("aim.late", { s: number(age / 1000, age < 10000 ? 1 : 0) });
    const seconds = late ? Math.floor(age / 1000) : 0;
    if (seconds !== this.#told) this.dispatchEvent(new CustomEvent("late", { detail: seconds }));
    this.#told = seconds;
  }

  #draw() {
    if (!this.#canvas.isConnected || !fitCanvas(this.#canvas)) return;
    const { width, height } = this.#canvas;
    const context = this.#canvas.getContext("2d");
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
    if (this.#active) ring(context, width / 2, height / 2, (disc * RING) / 2, this.#hint?.code);
  }
}

// A dark line under a bright one can be seen on any picture. Dashed and yellow until the device says ready, then solid and
// green: never by colour alone. Where to move stands as an arrow at the ring's rim.
function ring(context, x, y, radius, code) {
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
  if (turn !== undefined) arrow(context, x, y, radius, turn, strokes);
}

function arrow(context, x, y, radius, turn_deg, strokes) {
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

customElements.define("eye-live", EyeLive);
