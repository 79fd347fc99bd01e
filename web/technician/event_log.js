// <instrument-event-log>: event log of the instrument, of everything or of one picture; code and details are collapsed.
// Export as a file or to a USB drive.

import { sentences } from "../core/api.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { calendarDay, clockTime, t } from "../i18n/translate.js";

const LEVELS = { warning: "!", error: "✕", critical: "✕" };
const EXPORT = { method: "POST", headers: { "Content-Type": "application/json" } };

class EventLog extends HTMLElement {
  #state = { entries: null, warningsOnly: false, about: null, folders: null, message: "", error: "" };

  connectedCallback() {
    this.#load();
  }

  #set(more) {
    Object.assign(this.#state, more);
    render(view(this.#state, this.#actions), this);
  }

  /** Return the JSON answer of a request; on an error show the server's message and return null. */
  async #request(path, options) {
    const response = await fetch(path, { cache: "no-store", ...options }).catch(() => null);
    const body = await response?.json().catch(() => null);
    if (response?.ok && body) return body;
    this.#set({ error: body?.message ? sentences(body) : t("event-log.failed"), message: "" });
    return null;
  }

  async #load() {
    const { about } = this.#state;
    /** @type {Record<string, string>} */
    const query = about ? { limit: "300", about } : { limit: "300" };
    const answer = await this.#request(`/api/technician/event-log?${new URLSearchParams(query)}`);
    if (answer) this.#set({ entries: answer.entries, error: "" });
  }

  #actions = {
    again: () => this.#load(),
    warningsOnly: () => this.#set({ warningsOnly: !this.#state.warningsOnly }),
    showOnly: (about) => {
      this.#state.about = about;
      this.#load();
    },
    saved: () => this.#set({ folders: null, message: t("pictures.zipped"), error: "" }),
    listDrives: async () => {
      const answer = await this.#request("/api/exports");
      if (answer) this.#set({ folders: answer.folders, message: answer.folders.length ? "" : t("pictures.nofolder"), error: "" });
    },
    copy: async ({ id, name }) => {
      const done = await this.#request("/api/technician/event-log/export", { ...EXPORT, body: JSON.stringify({ folder: id }) });
      if (done) this.#set({ folders: null, message: t("event-log.copied", { folder: `${name}/${done.folder}` }), error: "" });
    },
  };
}

customElements.define("instrument-event-log", EventLog);

function view({ entries, warningsOnly, about, folders, message, error }, actions) {
  const shown = (entries ?? []).filter((entry) => !warningsOnly || entry.level in LEVELS);
  return html`
    <h2>${t("event-log.title")}</h2>
    <div class="row">
      <button type="button" @click=${actions.again}>${t("event-log.again")}</button>
      <button type="button" aria-pressed=${warningsOnly} @click=${actions.warningsOnly}>${t("event-log.worst")}</button>
      <a class="button" href="/api/technician/event-log.txt" download @click=${actions.saved}>${t("event-log.save")}</a>
      <button type="button" id="to-usb" @click=${actions.listDrives}>${t("pictures.copy")}</button>
      ${(folders ?? []).map((stick) => html`<button class="primary" type="button" data-folder=${stick.id} ?disabled=${!stick.is_writable} @click=${() => actions.copy(stick)}>
        ${stick.is_writable ? stick.name : t("pictures.readonly", stick)}
      </button>`)}
    </div>
    ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
    <p role="note">${message}</p>
    ${about ? html`<div class="row"><b>${t("event-log.about", { about })}</b>
      <button type="button" @click=${() => actions.showOnly(null)}>${t("event-log.all")}</button></div>` : nothing}
    <p role="status">${entries && (shown.length ? t("event-log.count", { count: shown.length }) : t("event-log.empty"))}</p>
    <ol class="event-log">${shown.map((entry) => entryItem(entry, actions, about))}</ol>
  `;
}

const entryItem = (entry, actions, about) => html`<li class=${entry.level}>
  <p><time datetime=${entry.at}>${calendarDay(entry.at)}, ${clockTime(entry.at)}</time>
    ${entry.level in LEVELS ? html`<b>${LEVELS[entry.level]} ${t(`event-log.${entry.level}`)}</b>` : nothing} ${entry.text}</p>
  ${entry.code || entry.about || entry.detail ? html`<details><summary>${t("event-log.more")}</summary>
    <p>${[entry.code, entry.about].filter(Boolean).join(" · ")}</p>
    ${entry.detail ? html`<pre>${entry.detail}</pre>` : nothing}
    ${entry.about && !about ? html`<button type="button" @click=${() => actions.showOnly(entry.about)}>${t("event-log.only")}</button>` : nothing}
  </details>` : nothing}
</li>`;
