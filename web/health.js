// How the instrument is: every check of its own with what was found, its limit, and what to do about it.

import { html, render } from "./vendor/lit-html.js";
import { t } from "./words.js";

const ASK_MS = 5000;

class InstrumentHealth extends HTMLElement {
  #timer = 0;

  connectedCallback() {
    this.#ask();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
  }

  async #ask() {
    try {
      const answer = await fetch("/api/health", { cache: "no-store" });
      render(answer.ok ? view(await answer.json()) : failed(), this);
    } catch {
      render(failed(), this);
    }
    if (this.isConnected) this.#timer = setTimeout(() => this.#ask(), ASK_MS);
  }
}

customElements.define("instrument-health", InstrumentHealth);

const failed = () => html`<p class="bad" role="alert">${t("health.failed")}</p>`;

function view({ ok, checks }) {
  return html`
    <h2>${t("health.title")}</h2>
    <p role="status">${t(ok ? "health.well" : "health.ill")}</p>
    <ul class="checks">${checks.map((one) => html`<li data-check=${one.name} data-ok=${one.ok}>
      <b>${one.ok ? (one.known ? "✓" : "–") : "✕"} ${t(`health.${one.name}`)}</b> <span>${one.value}</span>
      <small>${t("health.limit", { limit: one.limit })}</small>
      ${one.ok ? "" : html`<p class="bad">${one.remedy}</p>`}
    </li>`)}</ul>
  `;
}
