// The diary: what the instrument logged, a sentence first, its code and details folded; of everything or of one picture.
// It is taken away as a file, or onto a USB stick in the camera.

import { html, nothing, render } from "./vendor/lit-html.js";
import { calendarDay, clockTime, t } from "./words.js";

const LEVELS = { warning: "!", error: "✕", critical: "✕" };
const EXPORT = { method: "POST", headers: { "Content-Type": "application/json" } };

class InstrumentDiary extends HTMLElement {
  #now = { entries: null, worst: false, about: null, folders: null, said: "", bad: "" };

  connectedCallback() {
    this.#load();
  }

  #set(more) {
    Object.assign(this.#now, more);
    render(view(this.#now, this.#act), this);
  }

  /** What an address answers; where it refuses, its own words are shown, and the answer is null. */
  async #ask(path, options) {
    const answer = await fetch(path, { cache: "no-store", ...options }).catch(() => null);
    const said = await answer?.json().catch(() => null);
    if (answer?.ok && said) return said;
    this.#set({ bad: said?.message ? `${said.message} ${said.remedy}` : t("diary.failed"), said: "" });
    return null;
  }

  async #load() {
    const { about } = this.#now;
    const asked = about ? { limit: 300, about } : { limit: 300 };
    const answer = await this.#ask(`/api/technician/diary?${new URLSearchParams(asked)}`);
    if (answer) this.#set({ entries: answer.entries, bad: "" });
  }

  #act = {
    again: () => this.#load(),
    worst: () => this.#set({ worst: !this.#now.worst }),
    only: (about) => {
      this.#now.about = about;
      this.#load();
    },
    saved: () => this.#set({ folders: null, said: t("film.zipped"), bad: "" }),
    sticks: async () => {
      const answer = await this.#ask("/api/exports");
      if (answer) this.#set({ folders: answer.folders, said: answer.folders.length ? "" : t("film.nofolder"), bad: "" });
    },
    copy: async ({ id, name }) => {
      const done = await this.#ask("/api/technician/diary/export", { ...EXPORT, body: JSON.stringify({ folder: id }) });
      if (done) this.#set({ folders: null, said: t("diary.copied", { folder: `${name}/${done.folder}` }), bad: "" });
    },
  };
}

customElements.define("instrument-diary", InstrumentDiary);

function view({ entries, worst, about, folders, said, bad }, act) {
  const shown = (entries ?? []).filter((one) => !worst || one.level in LEVELS);
  return html`
    <h2>${t("diary.title")}</h2>
    <div class="row">
      <button type="button" @click=${act.again}>${t("diary.again")}</button>
      <button type="button" aria-pressed=${worst} @click=${act.worst}>${t("diary.worst")}</button>
      <a class="button" href="/api/technician/diary.txt" download @click=${act.saved}>${t("diary.save")}</a>
      <button type="button" id="to-usb" @click=${act.sticks}>${t("film.copy")}</button>
      ${(folders ?? []).map((stick) => html`<button class="primary" type="button" data-folder=${stick.id} @click=${() => act.copy(stick)}>
        ${stick.name}
      </button>`)}
    </div>
    ${bad ? html`<p class="bad" role="alert">${bad}</p>` : nothing}
    <p role="note">${said}</p>
    ${about ? html`<div class="row"><b>${t("diary.about", { about })}</b>
      <button type="button" @click=${() => act.only(null)}>${t("diary.all")}</button></div>` : nothing}
    <p role="status">${entries && (shown.length ? t("diary.count", { n: shown.length }) : t("diary.empty"))}</p>
    <ol class="diary">${shown.map((one) => line(one, act, about))}</ol>
  `;
}

const line = (one, act, about) => html`<li class=${one.level}>
  <p><time datetime=${one.at}>${calendarDay(one.at)}, ${clockTime(one.at)}</time>
    ${one.level in LEVELS ? html`<b>${LEVELS[one.level]} ${t(`diary.${one.level}`)}</b>` : nothing} ${one.text}</p>
  ${one.code || one.about || one.detail ? html`<details><summary>${t("diary.more")}</summary>
    <p>${[one.code, one.about].filter(Boolean).join(" · ")}</p>
    ${one.detail ? html`<pre>${one.detail}</pre>` : nothing}
    ${one.about && !about ? html`<button type="button" @click=${() => act.only(one.about)}>${t("diary.only")}</button>` : nothing}
  </details>` : nothing}
</li>`;
