// The diary: what the instrument logged, a sentence first, its code and details folded; of everything or of one picture.

import { html, render } from "./vendor/lit-html.js";
import { calendarDay, clockTime, t } from "./words.js";

const LEVELS = { warning: "!", error: "✕", critical: "✕" };

class InstrumentDiary extends HTMLElement {
  #entries = null;
  #failed = false;
  #worst = false;

  connectedCallback() {
    this.#load();
  }

  async #load() {
    try {
      const answer = await fetch("/api/technician/diary?limit=300", { cache: "no-store" });
      this.#failed = !answer.ok;
      if (answer.ok) this.#entries = (await answer.json()).entries;
    } catch {
      this.#failed = true;
    }
    this.#draw();
  }

  #draw() {
    render(view(this.#entries, this.#failed, this.#worst, this.#act), this);
  }

  #act = {
    again: () => this.#load(),
    worst: ({ target }) => {
      this.#worst = target.checked;
      this.#draw();
    },
    // A file for whoever is asked for help: the browser writes it where this tablet keeps downloads.
    save: () => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([JSON.stringify(this.#entries, null, 1)], { type: "application/json" }));
      link.download = "diary.json";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    },
  };
}

customElements.define("instrument-diary", InstrumentDiary);

function view(entries, failed, worst, act) {
  const shown = (entries ?? []).filter((one) => !worst || one.level in LEVELS);
  return html`
    <h2>${t("diary.title")}</h2>
    <div class="row">
      <button type="button" @click=${act.again}>${t("diary.again")}</button>
      <button type="button" @click=${act.save} ?hidden=${!entries?.length}>${t("diary.save")}</button>
      <label><input type="checkbox" .checked=${worst} @change=${act.worst} /> ${t("diary.worst")}</label>
    </div>
    ${failed ? html`<p class="bad" role="alert">${t("diary.failed")}</p>` : ""}
    <p role="status">${entries && (shown.length ? t("diary.count", { n: shown.length }) : t("diary.empty"))}</p>
    <ol class="diary">${shown.map((one) => html`<li class=${one.level}>
      <p><time datetime=${one.at}>${calendarDay(one.at)}, ${clockTime(one.at)}</time>
        ${one.level in LEVELS ? html`<b>${LEVELS[one.level]} ${t(`diary.${one.level}`)}</b>` : ""} ${one.text}</p>
      ${one.code || one.about || one.detail ? html`<details><summary>${t("diary.more")}</summary>
        <p>${[one.code, one.about].filter(Boolean).join(" · ")}</p>
        ${one.detail ? html`<pre>${one.detail}</pre>` : ""}
      </details>` : ""}
    </li>`)}</ol>
  `;
}
