// <bench-live>: raw sensor counts while a technician centres a source. Frames are pulled one by one, so a slow
// connection lowers the frame rate and not the freshness.

import { context2d } from "../core/viewport.js";
import { t } from "../i18n/translate.js";

const RETRY_MS = 500;
const RESPONSE_TIMEOUT_MS = 5000;

const delay = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

class SensorPreview extends HTMLElement {
  #active = false;
  #running = false;
  /** @type {ImageBitmap | null} */
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
    document.addEventListener("visibilitychange", () => this.#poll());
    this.#poll();
  }

  set active(on) {
    this.#active = on;
    this.#poll();
  }

  async #poll() {
    if (this.#running) return;
    this.#running = true;
    while (this.#active && !document.hidden && this.isConnected) await this.#fetchFrame();
    this.#running = false;
  }

  async #fetchFrame() {
    try {
      const signal = AbortSignal.timeout(RESPONSE_TIMEOUT_MS);
      const response = await fetch(`/api/calibration/preview?after=${this.#number}`, { cache: "no-store", signal });
      if (response.status !== 200) {
        this.#number = 0; // another calibration counts from the beginning
        await delay(RETRY_MS);
        return;
      }
      this.#number = Number(response.headers.get("X-Frame"));
      const old = this.#bitmap;
      this.#bitmap = await createImageBitmap(await response.blob());
      old?.close();
      this.#empty.textContent = "";
      this.dataset.frame = String(this.#number);
      this.#draw();
      const level = (name) => Number(response.headers.get(`X-${name}`));
      const detail = {
        brightest: level("Brightest"), mean: level("Mean"), full: level("Full"), exposure: level("Exposure-Ms"),
      };
      this.dispatchEvent(new CustomEvent("levels", { detail }));
    } catch {
      await delay(RETRY_MS); // the page shows the lost connection
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
    const context = context2d(canvas);
    context.drawImage(bitmap, left, top, wide, high);
    const [x, y, arm] = [canvas.width / 2, canvas.height / 2, Math.min(wide, high) * 0.2];
    context.lineWidth = 2 * scale;
    context.strokeStyle = "#ffd060";
    context.strokeRect(left, top, wide, high);
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + dx * arm * 0.15, y + dy * arm * 0.15);
      context.lineTo(x + dx * arm, y + dy * arm);
    }
    context.stroke();
  }
}

customElements.define("bench-live", SensorPreview);
