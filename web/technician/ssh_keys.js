// <ssh-keys>: the administrator confirms or refuses the keys for SSH in the file of the card; empty without one.

import { sentences } from "../core/api.js";
import { askIfRequired } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const STATES = new Map([[null, "ssh.asked"], [true, "ssh.confirmed"], [false, "ssh.refused"]]);

class SshKeys extends HTMLElement {
  #keys = [];
  #error = "";
  #reload = () => this.#send();

  connectedCallback() {
    document.addEventListener("login-changed", this.#reload);
    this.#send();
  }

  disconnectedCallback() {
    document.removeEventListener("login-changed", this.#reload);
  }

  /** Send a decision, or load the list without one; a refusal is shown, a missing login is asked for. */
  async #send(decision = undefined) {
    const change = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(decision) };
    const response = await fetch("/api/ssh-keys", { cache: "no-store", ...(decision && change) }).catch(() => null);
    const answer = await response?.json().catch(() => null);
    if (response?.ok && answer) this.#keys = answer.keys;
    const isShown = !response?.ok && !(answer?.code && askIfRequired(answer));
    this.#error = !isShown ? "" : answer?.message ? sentences(answer) : t("tech.lost");
    render(view(this.#keys, this.#error, (fingerprint, confirmed) => this.#send({ fingerprint, confirmed })), this);
  }
}

customElements.define("ssh-keys", SshKeys);

const view = (keys, error, decide) => (keys.length === 0 ? nothing : html`
  <h3>${t("ssh.title")}</h3>
  <p>${t("ssh.about")}</p>
  ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
  ${keys.map(({ fingerprint, comment, confirmed }) => html`<div class="card">
    <p><b>${comment}</b> <code>${fingerprint}</code>: ${t(STATES.get(confirmed))}</p>
    <button type="button" ?disabled=${confirmed === true} @click=${() => decide(fingerprint, true)}>${t("ssh.confirm")}</button>
    <button type="button" ?disabled=${confirmed === false} @click=${() => decide(fingerprint, false)}>${t("ssh.refuse")}</button>
  </div>`)}
`);
