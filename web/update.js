// Another version for the camera: look for it, install it, see what became of it. The updater is another process with
// rights of its own; this page only says what it wants, and shows what the updater wrote down.

import { html, nothing, render } from "./vendor/lit-html.js";
import { number, t } from "./words.js";
import { TECHNICIAN } from "./words_technician.js";

const ASK_MS = 1000;
const LOCK_MS = 600; // the second half of a double tap must not install what has just been found
const UNDER_WAY = ["asked", "looking", "fetching", "installing", "restarting", "trying"];
const AWAY = ["installing", "restarting", "trying"]; // when the camera restarts, it does not answer for a while
const NEWS_SHOWN = 5;

class SoftwareUpdate extends HTMLElement {
  #state = { told: null, waiting: 0, lost: false, alert: null, sent: null };
  #timer = 0;
  #sending = null;
  #lockedUntil = 0;

  connectedCallback() {
    this.#set({});
    this.#follow();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
    this.#sending?.abort();
  }

  #set(patch) {
    const before = this.#state.told?.state;
    this.#state = { ...this.#state, ...patch };
    if (this.#state.told?.state !== before) this.#lockedUntil = performance.now() + LOCK_MS;
    render(view(this.#state, this.#act), this);
  }

  async #follow() {
    clearTimeout(this.#timer);
    try {
      const answer = await fetch("/api/update", { cache: "no-store" });
      const waiting = this.#state.told?.found.length ? await unsent() : 0;
      if (answer.ok) this.#set({ told: await answer.json(), waiting, lost: false }); // otherwise the door is shut: the place says so
    } catch {
      this.#set({ lost: true });
    }
    if (this.isConnected) this.#timer = setTimeout(() => this.#follow(), ASK_MS);
  }

  async #tap(path, body = {}) {
    if (performance.now() < this.#lockedUntil) return;
    this.#lockedUntil = performance.now() + LOCK_MS;
    await this.#ask(path, body);
  }

  async #ask(path, body) {
    const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
    try {
      const answer = await fetch(`/api/update/${path}`, options);
      const said = await answer.json();
      this.#set(answer.ok ? { told: said, alert: null } : { alert: said });
    } catch {
      this.#set({ alert: { code: "link.cut", message: t("tech.lost"), remedy: "" } });
    }
  }

  #act = {
    look: () => this.#tap("check"),
    install: (id) => this.#tap("install", { id }),
    restart: () => this.#tap("restart"),
    stop: () => this.#sending?.abort(),
    send: ({ target }) => {
      const [file] = target.files;
      target.value = ""; // the same file can be chosen again
      if (file) this.#send(file);
    },
  };

  // fetch() does not tell how much it has sent.
  #send(file) {
    const request = new XMLHttpRequest();
    const over = (alert) => {
      this.#sending = null;
      this.#set({ sent: null, alert });
    };
    request.upload.onprogress = ({ loaded, total }) => this.#set({ sent: total ? loaded / total : 0 });
    request.onerror = () => over({ code: "link.cut", message: t("update.cut"), remedy: t("update.cut.remedy") });
    request.onabort = () => over(null);
    request.onload = () => {
      const well = request.status === 201;
      over(well ? null : (request.response ?? { code: "fault", message: t("fault.unknown"), remedy: "" }));
      if (well) this.#ask("check", {});
    };
    request.open("PUT", "/api/update/file");
    request.responseType = "json";
    request.send(file);
    this.#sending = request;
    this.#set({ sent: 0, alert: null });
  }
}

customElements.define("software-update", SoftwareUpdate);

const unsent = async () => (await (await fetch("/api/outbox", { cache: "no-store" })).json()).waiting;

function view(state, act) {
  const { told, waiting, lost, alert, sent } = state;
  if (!told) return html`<p role="status">${t("tech.opening")}</p>`;
  const away = lost && AWAY.includes(told.state);
  return html`
    <h2>${t("update.title")}</h2>
    <section class="update" data-state=${away ? "restarting" : told.state}>
      ${away ? restarting() : (STAGES[told.state] ?? nothing_)(told, act)}
      ${trouble(alert ?? told.trouble)}
      ${UNDER_WAY.includes(told.state) || !told.here ? nothing : choices(told, waiting, sent, act)}
    </section>
  `;
}

// ---- what became of it, and what to do: one picture of each stage

const head = (text, vars) => html`<p class="prompt" role="status">${t(text, vars)}</p>`;
const says = (text, vars) => html`<p>${t(text, vars)}</p>`;
const runs = ({ runs: version }) => says("update.runs", { version });
const nothing_ = (told) => html`${runs(told)} ${told.here ? "" : says("update.elsewhere")}`;
const restarting = () => html`${head("update.restarting")} ${bar(null)} ${says("update.back")}`;

const STAGES = {
  asked: () => html`${head("update.looking")} ${bar(null)}`,
  looking: () => html`${head("update.looking")} ${bar(null)}`,
  fetching: (told) => html`${head("update.fetching")} ${bar(told.share)} ${takes(told)} ${says("update.leave")}`,
  installing: (told) => html`
    ${head("update.installing", told)} ${bar(told.share)}
    ${takes(told, told.found.find(({ version }) => version === told.version)?.takes_s)} ${says("update.power")}
  `,
  restarting,
  trying: (told) => html`${head("update.trying", told)} ${bar(null)} ${says("update.trying.why", told)}`,
  installed: (told, act) => html`
    ${head("update.installed", told)}
    <button type="button" class="primary" id="restart" @click=${act.restart}>${t("update.restart")}</button>
  `,
  committed: (told) => html`${head("update.done", told)} ${news(told.news)}`,
  "went back": (told) => html`${head("update.failed")} ${says("update.failed.tried", told)} ${runs(told)}`,
  lost: (told) => html`${head("update.failed")} ${says("update.failed.lost", told)} ${runs(told)}`,
  interrupted: (told) => html`${head("update.interrupted")} ${runs(told)}`,
  refused: (told) => html`${head("update.refused")} ${runs(told)}`,
};

// What the last one took on this camera; for the first one a guess that says so; of a server's, whose link nobody knows,
// nothing.
function takes({ took_s: took }, guess) {
  const minutes = (seconds) => Math.max(1, Math.ceil(seconds / 60));
  const known = took ? t("update.took", { n: minutes(took) }) : "";
  const guessed = guess ? t("update.guess", { from: minutes(guess[0]), n: minutes(guess[1]) }) : "";
  return html`<p>${known || guessed} ${t("update.itself")}</p>`;
}

function bar(share) {
  if (share === null) return html`<progress max="1" aria-label=${t("update.progress")}></progress>`;
  return html`<div class="row"><progress max="1" .value=${share} aria-label=${t("update.progress")}></progress>
    <b>${t("unit.percent", { v: number(100 * share, 0) })}</b></div>`;
}

function trouble(one) {
  if (!one) return nothing;
  return html`<div class="alert" role="alert" data-code=${one.code}><p>${why(one)}</p></div>`;
}

// What is the matter, what to do, and the updater's own words, which name versions and numbers.
function why({ code, message, remedy }) {
  const known = `why.${code}` in TECHNICIAN;
  return html`<strong>${known ? t(`why.${code}`) : message}</strong> ${remedy} ${known ? html`<small>${message}</small>` : nothing}`;
}

function news(items) {
  if (!items.length) return nothing;
  const list = (some) => html`<ul class="news">${some.map((item) => html`<li>${item}</li>`)}</ul>`;
  const more = items.slice(NEWS_SHOWN);
  return html`
    <h3>${t("update.news")}</h3>
    ${list(items.slice(0, NEWS_SHOWN))}
    ${more.length ? html`<details><summary>${t("update.news.more")}</summary>${list(more)}</details>` : nothing}
  `;
}

// ---- what there is to install, and where to look

function choices(told, waiting, sent, act) {
  if (sent !== null) {
    return html`
      ${head("update.sending")} ${bar(sent)} ${says("update.stay")}
      <button type="button" @click=${act.stop}>${t("update.stop")}</button>
    `;
  }
  const empty = told.looked && !told.found.length && told.state === "none" && !told.trouble;
  return html`
    ${empty ? head("update.nothing") : nothing}
    ${waiting ? html`<p id="unsent">${t("update.unsent", { n: waiting })} ${t("update.unsent.safe")}</p>` : nothing}
    ${told.found.length ? html`<ul class="checks">${told.found.map((one) => found(told, one, act))}</ul>` : nothing}
    ${told.offered && !told.looked ? says("update.offered", { version: told.offered }) : nothing}
    <p class="muted">${t("update.where")}</p>
    <div class="row">
      <button type="button" id="look" class=${told.found.length ? "" : "primary"} @click=${act.look}
      >${t(told.looked ? "update.again" : "update.look")}</button>
      <label class="button"><input type="file" class="unseen" accept=".raucb" @change=${act.send} />${t("update.send")}</label>
    </div>
  `;
}

function found(told, { id, where, stick, name, bytes, version, trouble: no, takes_s: guess }, act) {
  const place = t(`update.from.${where}`, { stick: stick || name });
  return html`
    <li data-id=${id} data-code=${no?.code ?? "ok"}>
      <p><b>${version ? t("update.version", { version }) : name}</b></p>
      <small>${place} · ${name} · ${t("update.megabytes", { n: number(bytes / 1e6, 0) })}</small>
      ${no
        ? html`<p class="bad">${why(no)}</p>`
        : html`${takes(told, guess)} ${says("update.power")}
            <button type="button" class="primary" @click=${() => act.install(id)}>${t("update.install", { version })}</button>`}
    </li>
  `;
}
