// <instrument-audit>: the administrator's view of the audit log: who did what, and whether the log is as it was written.

import { when } from "./page_parts.js";
import { sentences } from "../core/api.js";
import { askIfRequired } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const FILTERS = ["user", "action", "record"];

class InstrumentAudit extends HTMLElement {
  #state = { log: /** @type {any} */ (null), filter: /** @type {Record<string, string>} */ ({}), error: "" };
  #reload = () => this.#load();

  connectedCallback() {
    document.addEventListener("login-changed", this.#reload);
    this.#load();
  }

  disconnectedCallback() {
    document.removeEventListener("login-changed", this.#reload);
  }

  async #load() {
    const response = await fetch(`/api/audit?${new URLSearchParams(this.#state.filter)}`, { cache: "no-store" }).catch(() => null);
    const answer = await response?.json().catch(() => null);
    if (response?.ok && answer) Object.assign(this.#state, { log: answer, error: "" });
    else if (!answer?.code || !askIfRequired(answer)) this.#state.error = answer?.message ? sentences(answer) : t("tech.lost");
    render(view(this.#state, this.#filter), this);
  }

  /** @param {SubmitEvent} event */
  #filter = (event) => {
    event.preventDefault();
    const typed = new FormData(/** @type {HTMLFormElement} */ (event.target));
    this.#state.filter = Object.fromEntries([...typed].filter(([, text]) => text).map(([name, text]) => [name, String(text).trim()]));
    this.#load();
  };
}

customElements.define("instrument-audit", InstrumentAudit);

function view({ log, error }, filter) {
  return html`
    <h2>${t("section.audit")}</h2>
    ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
    ${log ? html`<p role="status">${log.problem ? t("audit.problem", { problem: log.problem }) : t("audit.whole", { count: log.count })}</p>` : nothing}
    <form class="card audit-filter" @submit=${filter}>
      ${FILTERS.map((name) => html`<label class="field">${t(`audit.${name}`)}<input name=${name} maxlength="40" autocomplete="off" /></label>`)}
      <button type="submit">${t("audit.filter")}</button>
    </form>
    ${log ? list(log.entries) : nothing}
  `;
}

const list = (entries) => html`<ul class="audit">
  ${entries.map((entry) => html`<li>
    <b>${entry.user || t("audit.anonymous")}</b> ${entry.action} ${entry.record}
    <small>${entry.number} · ${when(entry.at)} · ${Object.values(entry.more).join(" · ")}</small>
  </li>`)}
</ul>`;
