// <instrument-backup>: encrypted backup of everything that is stored to a USB stick, and the passphrase that restores it.

import { sentences } from "../core/api.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { calendarDay, clockTime, t } from "../i18n/translate.js";

const POLL_MS = 500;
const URL = "/api/technician/backup";
const post = (body) => ({ method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

class Backup extends HTMLElement {
  #state = { backup: null, sticks: null, choosing: false, busy: false, begun: false, error: "", message: "" };
  #timer = 0;

  connectedCallback() {
    this.#load();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
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
    this.#set({ error: body?.message ? sentences(body) : t("backup.failed"), message: "" });
    return null;
  }

  #show(backup) {
    clearTimeout(this.#timer);
    if (backup.total !== null) {
      this.#set({ backup, begun: true, error: "", message: "" });
      this.#timer = setTimeout(() => this.#load(), POLL_MS);
      return;
    }
    const error = backup.error ? sentences(backup.error) : "";
    const { begun, message } = this.#state;
    this.#set({ backup, begun: false, error, message: begun && !error ? t("backup.done", { folder: folderName(backup.last) }) : message });
  }

  async #load() {
    const backup = await this.#request(URL);
    if (backup) this.#show(backup);
  }

  #actions = {
    choose: () => this.#set({ choosing: true, error: "", message: "" }),
    setPassphrase: async (event) => {
      event.preventDefault();
      const [passphrase, again] = new FormData(event.target).getAll("passphrase");
      if (passphrase !== again) {
        this.#set({ error: t("backup.differ"), message: "" });
        return;
      }
      this.#set({ busy: true, error: "" });
      const backup = await this.#request(`${URL}/passphrase`, post({ passphrase }));
      this.#set({ busy: false });
      if (!backup) return;
      this.#set({ choosing: false, message: t("backup.set") });
      this.#show(backup);
    },
    listDrives: async () => {
      const answer = await this.#request("/api/exports");
      if (answer) this.#set({ sticks: answer.folders, error: "", message: answer.folders.length ? "" : t("pictures.nofolder") });
    },
    begin: async ({ id }) => {
      this.#set({ sticks: null, message: "", error: "" });
      if (!(await this.#request(URL, post({ folder: id })))) return;
      this.#set({ begun: true });
      this.#load();
    },
  };
}

customElements.define("instrument-backup", Backup);

const folderName = (last) => last.folder.split("/").slice(-2).join("/");

function view({ backup, sticks, choosing, busy, error, message }, actions) {
  if (!backup) return html`<h2>${t("backup.title")}</h2>${alert(error)}`;
  const asks = choosing || !backup.has_key;
  return html`
    <h2>${t("backup.title")}</h2>
    <p>${t("backup.what")}</p>
    <p role="status" data-due=${backup.is_due}>${lastLine(backup)}</p>
    ${backup.total === null ? nothing : progressBar(backup)}
    ${alert(error)}
    <p role="note">${message}</p>
    ${asks ? passphraseForm(actions, busy) : backup.total === null ? driveButtons(sticks, actions) : nothing}
  `;
}

const alert = (error) => (error ? html`<p class="bad" role="alert">${error}</p>` : nothing);

function lastLine({ last, is_due: isDue }) {
  const due = isDue ? html` <b>${t("backup.due")}</b>` : nothing;
  if (!last) return html`${t("backup.none")}${due}`;
  const megabytes = (last.written_bytes / 1e6).toFixed(1);
  return html`${t("backup.last", { day: calendarDay(last.made_at), time: clockTime(last.made_at), mb: megabytes })}${due}`;
}

const progressBar = ({ done, total }) => html`<label class="progress">${t("backup.under", { done, total })}
  <progress max=${Math.max(total, 1)} .value=${done}></progress></label>`;

const driveButtons = (sticks, actions) => html`<div class="row">
  ${sticks?.length
    ? sticks.map((stick) => html`<button class="primary" type="button" data-folder=${stick.id} ?disabled=${!stick.is_writable} @click=${() => actions.begin(stick)}>
        ${stick.is_writable ? t("backup.to", { name: stick.name }) : t("pictures.readonly", stick)}
      </button>`)
    : html`<button class="primary" type="button" id="back-up" @click=${actions.listDrives}>${t("backup.begin")}</button>`}
  <button type="button" id="new-passphrase" @click=${actions.choose}>${t("backup.choose")}</button>
</div>`;

const passphraseForm = (actions, busy) => html`<form class="column" @submit=${actions.setPassphrase}>
  <p>${t("backup.why")}</p>
  <label>${t("backup.passphrase")}
    <input name="passphrase" type="password" minlength="8" maxlength="1000" autocomplete="new-password" required /></label>
  <label>${t("backup.repeat")}
    <input name="passphrase" type="password" minlength="8" maxlength="1000" autocomplete="new-password" required /></label>
  <button class="primary" type="submit" ?disabled=${busy}>${busy ? t("backup.wait") : t("backup.save")}</button>
</form>`;
