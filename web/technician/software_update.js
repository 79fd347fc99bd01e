// <software-update>: search, upload and installation of an update, and its result. A separate privileged process does
// the work; this element sends requests and shows the recorded status.

import { buttonsChanged } from "../core/taps.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { has, number, t } from "../i18n/translate.js";

const POLL_MS = 1000;
const IN_PROGRESS = ["asked", "looking", "fetching", "installing", "restarting", "trying"];
const MAY_RESTART = ["installing", "restarting", "trying"]; // states in which a restart may interrupt the connection
const NEWS_SHOWN = 5;

class SoftwareUpdate extends HTMLElement {
  /** @type {Record<string, any>} */
  #state = { status: null, waiting: 0, lost: false, alert: null, sent: null };
  #timer = 0;
  /** @type {XMLHttpRequest | null} */
  #uploadRequest = null;

  connectedCallback() {
    this.#set({});
    this.#poll();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
    this.#uploadRequest?.abort();
  }

  #set(patch) {
    const before = this.#state.status?.state;
    this.#state = { ...this.#state, ...patch };
    if (this.#state.status?.state !== before) buttonsChanged();
    render(view(this.#state, this.#actions), this);
  }

  async #poll() {
    clearTimeout(this.#timer);
    try {
      const response = await fetch("/api/update", { cache: "no-store" });
      const waiting = this.#state.status?.found.length ? await fetchWaiting() : 0;
      if (response.ok) this.#set({ status: await response.json(), waiting, lost: false }); // otherwise the login has expired, which the page shows
    } catch {
      this.#set({ lost: true });
    }
    if (this.isConnected) this.#timer = setTimeout(() => this.#poll(), POLL_MS);
  }

  async #submit(path, body = {}) {
    const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
    try {
      const response = await fetch(`/api/update/${path}`, options);
      const json = await response.json();
      this.#set(response.ok ? { status: json, alert: null } : { alert: json });
    } catch {
      this.#set({ alert: { code: "link.cut", message: t("tech.lost"), remedy: "" } });
    }
  }

  #actions = {
    look: () => this.#submit("check"),
    install: (id) => this.#submit("install", { id }),
    restart: () => this.#submit("restart"),
    stop: () => this.#uploadRequest?.abort(),
    send: ({ target }) => {
      const [file] = target.files;
      target.value = ""; // so that the same file can be chosen again
      if (file) this.#upload(file);
    },
  };

  // XMLHttpRequest, because fetch() does not report upload progress.
  #upload(file) {
    const request = new XMLHttpRequest();
    const done = (alert) => {
      this.#uploadRequest = null;
      this.#set({ sent: null, alert });
    };
    request.upload.onprogress = ({ loaded, total }) => this.#set({ sent: total ? loaded / total : 0 });
    request.onerror = () => done({ code: "link.cut", message: t("update.cut"), remedy: t("update.cut.remedy") });
    request.onabort = () => done(null);
    request.onload = () => {
      const ok = request.status === 201;
      done(ok ? null : (request.response ?? { code: "fault", message: t("fault.unknown"), remedy: "" }));
      if (ok) this.#submit("check");
    };
    request.open("PUT", "/api/update/file");
    request.responseType = "json";
    request.send(file);
    this.#uploadRequest = request;
    this.#set({ sent: 0, alert: null });
  }
}

customElements.define("software-update", SoftwareUpdate);

const fetchWaiting = async () => (await (await fetch("/api/upload-queue", { cache: "no-store" })).json()).waiting;

function view(state, actions) {
  const { status, waiting, lost, alert, sent } = state;
  if (!status) return html`<p role="status">${t("tech.opening")}</p>`;
  const restartingNow = lost && MAY_RESTART.includes(status.state);
  return html`
    <h2>${t("update.title")}</h2>
    <section class="update" data-state=${restartingNow ? "restarting" : status.state}>
      ${restartingNow ? restarting() : (STAGES[status.state] ?? idle)(status, actions)}
      ${errorBox(alert ?? status.trouble)}
      ${IN_PROGRESS.includes(status.state) || !status.here ? nothing : choices(status, waiting, sent, actions)}
    </section>
  `;
}

// ---- one template per state

const headline = (text, vars) => html`<p class="prompt" role="status">${t(text, vars)}</p>`;
const paragraph = (text, vars) => html`<p>${t(text, vars)}</p>`;
const runningVersion = ({ runs: version }) => paragraph("update.runs", { version });
const idle = (status) => html`${runningVersion(status)} ${status.here ? "" : paragraph("update.elsewhere")}`;
const restarting = () => html`${headline("update.restarting")} ${progressBar(null)} ${paragraph("update.back")}`;

const STAGES = {
  asked: () => html`${headline("update.looking")} ${progressBar(null)}`,
  looking: () => html`${headline("update.looking")} ${progressBar(null)}`,
  fetching: (status) => html`${headline("update.fetching")} ${progressBar(status.share)} ${duration(status)} ${paragraph("update.leave")}`,
  installing: (status) => html`
    ${headline("update.installing", status)} ${progressBar(status.share)}
    ${duration(status, status.found.find(({ version }) => version === status.version)?.takes_s)} ${paragraph("update.power")}
  `,
  restarting,
  trying: (status) => html`${headline("update.trying", status)} ${progressBar(null)} ${paragraph("update.trying.why", status)}`,
  installed: (status, actions) => html`
    ${headline("update.installed", status)}
    <button type="button" class="primary" id="restart" @click=${actions.restart}>${t("update.restart")}</button>
  `,
  committed: (status) => html`${headline("update.done", status)} ${news(status.news)}`,
  "went back": (status) => html`${headline("update.failed")} ${paragraph("update.failed.tried", status)} ${runningVersion(status)}`,
  lost: (status) => html`${headline("update.failed")} ${paragraph("update.failed.lost", status)} ${runningVersion(status)}`,
  interrupted: (status) => html`${headline("update.interrupted")} ${runningVersion(status)}`,
  refused: (status) => html`${headline("update.refused")} ${runningVersion(status)}`,
};

// Return the duration of the last update on this device, else an estimate; no estimate for a download, whose speed is
// unknown.
function duration({ took_s: took }, guessS) {
  const minutes = (seconds) => Math.max(1, Math.ceil(seconds / 60));
  const known = took ? t("update.took", { count: minutes(took) }) : "";
  const guessed = guessS ? t("update.guess", { from: minutes(guessS[0]), count: minutes(guessS[1]) }) : "";
  return html`<p>${known || guessed} ${t("update.itself")}</p>`;
}

function progressBar(share) {
  if (share === null) return html`<progress max="1" aria-label=${t("update.progress")}></progress>`;
  return html`<div class="row"><progress max="1" .value=${share} aria-label=${t("update.progress")}></progress>
    <b>${t("unit.percent", { v: number(100 * share, 0) })}</b></div>`;
}

function errorBox(error) {
  if (!error) return nothing;
  return html`<div class="alert" role="alert" data-code=${error.code}><p>${errorText(error)}</p></div>`;
}

// Return problem, remedy and the updater's message, which holds versions and numbers.
function errorText({ code, message, remedy }) {
  const known = has(`why.${code}`);
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

// ---- available updates, search and upload

function choices(status, waiting, sent, actions) {
  if (sent !== null) {
    return html`
      ${headline("update.sending")} ${progressBar(sent)} ${paragraph("update.stay")}
      <button type="button" @click=${actions.stop}>${t("update.stop")}</button>
    `;
  }
  const empty = status.looked && !status.found.length && status.state === "none" && !status.trouble;
  return html`
    ${empty ? headline("update.nothing") : nothing}
    ${waiting ? html`<p id="unsent">${t("update.unsent", { count: waiting })} ${t("update.unsent.safe")}</p>` : nothing}
    ${status.found.length ? html`<ul class="checks">${status.found.map((bundle) => bundleItem(status, bundle, actions))}</ul>` : nothing}
    ${status.offered && !status.looked ? paragraph("update.offered", { version: status.offered }) : nothing}
    <p class="muted">${t("update.where")}</p>
    <div class="row">
      <button type="button" id="look" class=${status.found.length ? "" : "primary"} @click=${actions.look}
      >${t(status.looked ? "update.again" : "update.look")}</button>
      <label class="button"><input type="file" class="unseen" accept=".raucb" @change=${actions.send} />${t("update.send")}</label>
    </div>
  `;
}

function bundleItem(status, { id, where, stick, name, bytes, version, trouble: no, takes_s: guessS }, actions) {
  const place = t(`update.from.${where}`, { stick: stick || name });
  return html`
    <li data-id=${id} data-code=${no?.code ?? "ok"}>
      <p><b>${version ? t("update.version", { version }) : name}</b></p>
      <small>${place} · ${name} · ${t("update.megabytes", { count: number(bytes / 1e6, 0) })}</small>
      ${no
        ? html`<p class="bad">${errorText(no)}</p>`
        : html`${duration(status, guessS)} ${paragraph("update.power")}
            <button type="button" class="primary" @click=${() => actions.install(id)}>${t("update.install", { version })}</button>`}
    </li>
  `;
}
