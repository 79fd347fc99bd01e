// <stored-pictures>: room on the card; pictures that were exported or sent can be removed, and brought back.

import { sentences } from "../core/api.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const URL = "/api/technician/removal";

class StoredPictures extends HTMLElement {
  #state = { removal: null, asks: false, error: "", message: "" };

  connectedCallback() {
    this.#request("GET", URL, "");
  }

  #set(more) {
    Object.assign(this.#state, more);
    render(view(this.#state, this.#actions), this);
  }

  /** Show the state that a request answers, and a message; on an error the server's message. */
  async #request(method, path, message) {
    const response = await fetch(path, { method, cache: "no-store" }).catch(() => null);
    const body = await response?.json().catch(() => null);
    if (response?.ok && body) this.#set({ removal: body, asks: false, error: "", message });
    else this.#set({ asks: false, error: body?.message ? sentences(body) : t("backup.failed"), message: "" });
  }

  #actions = {
    ask: () => this.#set({ asks: true, message: "", error: "" }),
    keep: () => this.#set({ asks: false }),
    remove: () => this.#request("POST", URL, t("stored.removed")),
    undo: () => this.#request("POST", `${URL}/undo`, t("stored.undone")),
  };
}

customElements.define("stored-pictures", StoredPictures);

const megabytes = (bytes) => Math.ceil(bytes / 1e6);

function view({ removal, asks, error, message }, actions) {
  return html`
    <h2>${t("section.space")}</h2>
    <p>${t("stored.rule")}</p>
    ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
    ${removal ? html`<p role="status">${removable(removal)}</p>${asks ? question(removal, actions) : buttons(removal, actions)}` : nothing}
    <p role="note">${message}</p>
  `;
}

const removable = ({ visits, captures, size_bytes: bytes, oldest_day: from, newest_day: to }) =>
  visits ? t("stored.removable", { visits, captures, mb: megabytes(bytes), from, to }) : t("stored.none");

const question = ({ captures }, actions) => html`<p><b>${t("stored.sure", { captures })}</b></p>
  <div class="row">
    <button class="primary" type="button" id="remove-now" @click=${actions.remove}>${t("stored.remove")}</button>
    <button type="button" @click=${actions.keep}>${t("stored.keep")}</button>
  </div>`;

const buttons = ({ visits, undoable_captures: undoable, undoable_bytes: bytes }, actions) => html`<div class="row">
  ${visits ? html`<button class="primary" type="button" id="remove" @click=${actions.ask}>${t("stored.remove")}</button>` : nothing}
  ${undoable
    ? html`<button type="button" id="undo-removal" @click=${actions.undo}>${t("stored.undo", { count: undoable, mb: megabytes(bytes) })}</button>`
    : nothing}
</div>`;
