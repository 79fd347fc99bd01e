// <instrument-health>: self-checks with value, limit and remedy. Failed checks come first, in a live region; a tap
// speaks the remedy, for hands-free repair.

import { icon } from "../components/icons.js";
import { pictureRenderer } from "../components/viewer/renderer.js";
import { qrCode } from "../core/qr_code.js";
import { copyText, reportPanel, reportText, save } from "./health_report.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { onVoicesChanged, speakSentence, voiceFor } from "../core/speech_synthesis.js";
import { t } from "../i18n/translate.js";

const POLL_MS = 5000;

class InstrumentHealth extends HTMLElement {
  #timer = 0;
  #abort = new AbortController();
  /** @type {any} */
  #health = null; // latest answer of the server, or null
  #large = ""; // the check that was not spoken and is shown in large letters
  #status = { name: "", version: "" };
  /** @type {{size: number, path: string} | null} */
  #code = null; // QR code of the report, while visible
  #message = "";

  connectedCallback() {
    this.#abort = new AbortController();
    onVoicesChanged(() => this.#draw(), this.#abort.signal);
    this.#poll();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
    this.#abort.abort();
  }

  async #poll() {
    try {
      const [response, status] = await Promise.all(
        ["/api/health", "/api/status"].map((path) => fetch(path, { cache: "no-store" })),
      );
      this.#health = response.ok ? await response.json() : null;
      if (status.ok) this.#status = await status.json();
    } catch {
      this.#health = null;
    }
    this.#draw();
    if (this.isConnected) this.#timer = setTimeout(() => this.#poll(), POLL_MS);
  }

  #draw() {
    if (!this.#health) return render(failed(), this);
    const panel = reportPanel({ text: this.#text(), code: this.#code, message: this.#message }, this.#reportActions);
    return render([view(this.#health, this.#large, this.#speak), panel], this);
  }

  #text() {
    return reportText(this.#health, this.#status, rendererName());
  }

  #showMessage(message) {
    this.#message = message;
    this.#draw();
  }

  #reportActions = {
    copy: () => this.#showMessage(t(copyText(this.querySelector("textarea")) ? "report.copied" : "report.notcopied")),
    save: () => save(this.#text()),
    code: () => {
      this.#code = this.#code ? null : qrCode(this.#text());
      this.#draw();
    },
  };

  #speak = async ({ name, remedy }) => {
    this.#large = "";
    this.#draw();
    const spoken = await speakSentence(t("health.aloud", { name: t(`health.${name}`), remedy }), "en");
    if (spoken) return;
    this.#large = name;
    this.#draw();
  };
}

customElements.define("instrument-health", InstrumentHealth);

const failed = () => html`<p class="bad" role="alert">${t("health.failed")}</p>`;

function view({ ok, checks }, large, speakRemedy) {
  const unknown = checks.filter((check) => check.ok && !check.known).length;
  const lines = (which) => checks.filter((check) => check.ok === which).map((check) => checkItem(check, large === check.name, speakRemedy));
  return html`
    <h2>${t("health.title")}</h2>
    <div role="status" aria-atomic="false">
      <p>${t(ok ? (unknown ? "health.notill" : "health.well") : "health.ill", { count: unknown })}</p>
      ${ok ? nothing : html`<ul class="checks">${lines(false)}</ul>`}
    </div>
    <ul class="checks">
      ${lines(true)}
      <li data-painter><b>${t("health.painter")}</b> <span>${rendererName()}</span></li>
    </ul>
  `;
}

// Name of the active renderer; after a failed self-test it is the 2-D canvas.
const rendererName = () => t(pictureRenderer().renderer.name === "2d" ? "health.painter.2d" : "health.painter.gl");

const checkItem = (check, large, speakRemedy) => html`<li data-check=${check.name} data-ok=${check.ok}>
  <b>${check.ok ? (check.known ? "✓" : "–") : "✕"} ${t(`health.${check.name}`)}</b> <span>${check.value}</span>
  ${check.known ? html`<small>${t("health.limit", { limit: check.limit })}</small>` : nothing}
  ${check.ok ? nothing : html`<p class="bad" ?data-large=${large}>${check.remedy}</p> ${speakButton(check, speakRemedy)}`}
</li>`;

function speakButton(check, speakRemedy) {
  const able = voiceFor("en") !== null;
  const words = t(able ? "health.say" : "health.read", { name: t(`health.${check.name}`) });
  return html`<button type="button" @click=${() => speakRemedy(check)}>${icon(able ? "loud" : "read")} <span>${words}</span></button>`;
}
