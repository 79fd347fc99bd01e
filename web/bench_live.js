// <bench-live>: what the sensor sees while a technician centres a source; raw counts, not a reconstruction. Like the
// live picture of the retina it is pulled, one request at a time, so that a slow link makes fewer frames, not old ones.

import { t } from "./words.js";

const RETRY_MS = 500;
const ANSWER_MS = 5000;

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

class BenchLive extends HTMLElement {
  #active = false;
  #running = false;
  #bitmap = null;
  #number = 0;
  #canvas = document.createElement("canvas");
  #empty = document.createElement("p");

  connectedCallback() {
    if (this.#canvas.isConnected) return;
    this.#canvas.setAttribute("role", "img");
    this.#canvas.setAttribute("aria-label", t("live.name"));
    this.#empty.className = "empty";
    this.#empty.textContent = t("live.waiting");
    this.append(this.#canvas, this.#empty);
    new ResizeObserver(() => this.#draw()).observe(this);
    document.addEventListener("visibilitychange", () => this.#run());
    this.#run();
  }

  set active(on) {
    this.#active = on;
    this.#run();
  }

  async #run() {
    if (this.#running) return;
    this.#running = true;
    while (this.#active && !document.hidden && this.isConnected) await this.#next();
    this.#running = false;
  }

  async #next() {
    try {
      const signal = AbortSignal.timeout(ANSWER_MS);
      const answer = await fetch(`/api/calibration/preview?after=${this.#number}`, { cache: "no-store", signal });
      if (answer.status !== 200) {
        this.#number = 0; // another calibration counts from the beginning
        await pause(RETRY_MS);
        return;
      }
      this.#number = Number(answer.headers.get("X-Frame"));
      const old = this.#bitmap;
      this.#bitmap = await createImageBitmap(await answer.blob());
      old?.close();
      this.#empty.textContent = "";
      this.dataset.frame = this.#number;
      this.#draw();
      const level = (name) => Number(answer.headers.get(`X-${name}`));
      const detail = {
        brightest: level("Brightest"), mean: level("Mean"), full: level("Full"), exposure: level("Exposure-Ms"),
      };
      this.dispatchEvent(new CustomEvent("levels", { detail }));
    } catch {
      await pause(RETRY_MS); // the page tells about a lost link
    }
  }

  #draw() {
    const canvas = this.#canvas;
    const scale = devicePixelRatio || 1;
    canvas.width = Math.round(this.clientWidth * scale);
    canvas.height = Math.round(this.clientHeight * scale);
    const bitmap = this.#bitmap;
    if (!bitmap || !canvas.width) return;
    const zoom = Math.min(canvas.width / bitmap.width, canvas.height / bitmap.height);
    const [wide, high] = [bitmap.width * zoom, bitmap.height * zoom];
    const [left, top] = [(canvas.width - wide) / 2, (canvas.height - high) / 2];
    const pen = canvas.getContext("2d");
    pen.drawImage(bitmap, left, top, wide, high);
    const [x, y, arm] = [canvas.width / 2, canvas.height / 2, Math.min(wide, high) * 0.2];
    pen.lineWidth = 2 * scale;
    pen.strokeStyle = "#ffd060";
    pen.strokeRect(left, top, wide, high);
    pen.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + dx * arm * 0.15, y + dy * arm * 0.15);
      pen.lineTo(x + dx * arm, y + dy * arm);
    }
    pen.stroke();
  }
}

customElements.define("bench-live", BenchLive);
