// How the instrument is: every check of its own with what was found, its limit, and what to do about it. What fails comes
// first, is told to a screen reader, and is read aloud by a tap: people mend things with their hands and eyes elsewhere.

import { icon } from "./icons.js";
import { studio } from "./painter.js";
import { codeOf } from "./qr.js";
import { copied, report, reportOf, save } from "./report.js";
import { html, nothing, render } from "./vendor/lit-html.js";
import { onVoices, speak, voiceFor } from "./voice.js";
import { t } from "./words.js";

const ASK_MS = 5000;

class InstrumentHealth extends HTMLElement {
  #timer = 0;
  #gone = null;
  #health = null; // what the instrument said last; null when it said nothing
  #large = ""; // the check that could not be heard and is shown large instead
  #status = { name: "", version: "" };
  #code = null; // the report as one, while it is shown
  #said = "";

  connectedCallback() {
    this.#gone = new AbortController();
    onVoices(() => this.#draw(), this.#gone.signal);
    this.#ask();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
    this.#gone.abort();
  }

  async #ask() {
    try {
      const [answer, status] = await Promise.all(
        ["/api/health", "/api/status"].map((path) => fetch(path, { cache: "no-store" })),
      );
      this.#health = answer.ok ? await answer.json() : null;
      if (status.ok) this.#status = await status.json();
    } catch {
      this.#health = null;
    }
    this.#draw();
    if (this.isConnected) this.#timer = setTimeout(() => this.#ask(), ASK_MS);
  }

  #draw() {
    if (!this.#health) return render(failed(), this);
    const told = report({ text: this.#text(), code: this.#code, said: this.#said }, this.#report);
    return render([view(this.#health, this.#large, this.#say), told], this);
  }

  #text() {
    return reportOf(this.#health, this.#status, paintedBy());
  }

  #tell(said) {
    this.#said = said;
    this.#draw();
  }

  #report = {
    copy: () => this.#tell(t(copied(this.querySelector("textarea")) ? "report.copied" : "report.notcopied")),
    save: () => save(this.#text()),
    code: async () => {
      this.#code = this.#code ? null : await codeOf(this.#text());
      this.#draw();
    },
  };

  #say = async ({ name, remedy }) => {
    this.#large = "";
    this.#draw();
    const heard = await speak(t("health.aloud", { name: t(`health.${name}`), remedy }), "en");
    if (heard) return;
    this.#large = name;
    this.#draw();
  };
}

customElements.define("instrument-health", InstrumentHealth);

const failed = () => html`<p class="bad" role="alert">${t("health.failed")}</p>`;

function view({ ok, checks }, large, say) {
  const unknown = checks.filter((one) => one.ok && !one.known).length;
  const lines = (which) => checks.filter((one) => one.ok === which).map((one) => line(one, large === one.name, say));
  return html`
    <h2>${t("health.title")}</h2>
    <div role="status" aria-atomic="false">
      <p>${t(ok ? (unknown ? "health.notill" : "health.well") : "health.ill", { n: unknown })}</p>
      ${ok ? nothing : html`<ul class="checks">${lines(false)}</ul>`}
    </div>
    <ul class="checks">
      ${lines(true)}
      <li data-painter><b>${t("health.painter")}</b> <span>${paintedBy()}</span></li>
    </ul>
  `;
}

// Which of the two painters this page has, on this tablet: cheap chips draw wrong, and then the processor does it.
const paintedBy = () => t(studio().painter.name === "2d" ? "health.painter.2d" : "health.painter.gl");

const line = (one, large, say) => html`<li data-check=${one.name} data-ok=${one.ok}>
  <b>${one.ok ? (one.known ? "✓" : "–") : "✕"} ${t(`health.${one.name}`)}</b> <span>${one.value}</span>
  ${one.known ? html`<small>${t("health.limit", { limit: one.limit })}</small>` : nothing}
  ${one.ok ? nothing : html`<p class="bad" ?data-large=${large}>${one.remedy}</p> ${loud(one, say)}`}
</li>`;

function loud(one, say) {
  const able = voiceFor("en") !== null;
  const words = t(able ? "health.say" : "health.read", { name: t(`health.${one.name}`) });
  return html`<button type="button" @click=${() => say(one)}>${icon(able ? "loud" : "read")} <span>${words}</span></button>`;
}
