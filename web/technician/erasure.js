// <patient-erasure>: the administrator erases a patient: number, what is stored, number and reason, receipt.

import { save } from "./health_report.js";
import { sentences } from "../core/api.js";
import { askIfRequired } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const REASONS = ["withdrawn", "requested", "retention", "mistake"];
const EMPTY = { number: "", found: /** @type {any} */ (null), receipt: "", error: "" };

class PatientErasure extends HTMLElement {
  #state = { ...EMPTY };

  connectedCallback() {
    this.#set({});
  }

  #set(more) {
    Object.assign(this.#state, more);
    render(view(this.#state, this.#actions), this);
  }

  /** Return the answer to a request, null after a refusal, which is shown; a missing login is asked for. */
  async #request(path, options = {}) {
    const response = await fetch(`/api/patients${path}`, { cache: "no-store", ...options }).catch(() => null);
    const answer = await response?.json().catch(() => null);
    if (response?.ok && answer) return answer;
    const isAsked = answer?.code && askIfRequired(answer);
    this.#set({ error: isAsked ? "" : answer?.message ? sentences(answer) : t("tech.lost") });
    return null;
  }

  #actions = {
    find: async (event) => {
      event.preventDefault();
      const number = event.target.elements.number.value.trim();
      const found = await this.#request(`?${new URLSearchParams({ number })}`);
      if (found) this.#set({ ...EMPTY, number, found });
    },

    erase: async (event) => {
      event.preventDefault();
      const { number } = this.#state;
      const { again, reason } = event.target.elements;
      if (again.value.trim() !== number) return this.#set({ error: t("erase.differ") });
      const body = JSON.stringify({ number, reason: reason.value });
      const receipt = await this.#request("/erase", { method: "POST", headers: { "Content-Type": "application/json" }, body });
      return receipt && this.#set({ ...EMPTY, receipt: JSON.stringify(receipt, null, 1) });
    },

    keep: () => this.#set(EMPTY),
  };
}

customElements.define("patient-erasure", PatientErasure);

const view = ({ number, found, receipt, error }, actions) => html`
  <h2>${t("section.erase")}</h2>
  <p>${t("erase.about")}</p>
  ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
  <p role="status">${found ? t("erase.found", found) : receipt ? t("erase.done") : ""}</p>
  ${receipt ? html`<button type="button" id="receipt" @click=${() => save(receipt, "receipt.json")}>${t("erase.receipt")}</button>` : nothing}
  ${found ? question(number, actions) : html`<form class="card" autocomplete="off" @submit=${actions.find}>
    <label class="field">${t("erase.number")}<input name="number" maxlength="40" required /></label>
    <button type="submit">${t("erase.find")}</button>
  </form>`}
`;

const question = (number, actions) => html`<form class="card" autocomplete="off" @submit=${actions.erase}>
  <h3>${number}</h3>
  <label class="field">${t("erase.again")}<input name="again" maxlength="40" required /></label>
  <fieldset>
    <legend>${t("erase.reason")}</legend>
    ${REASONS.map((reason) => html`<label><input type="radio" name="reason" value=${reason} required /> ${t(`erase.${reason}`)}</label>`)}
  </fieldset>
  <button class="primary" type="submit">${t("erase.now")}</button>
  <button type="button" @click=${actions.keep}>${t("erase.keep")}</button>
</form>`;
