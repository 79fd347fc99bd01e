// <accuracy-time>: accuracy against reconstruction time, measured on this device or shipped, comparison of a capture at a
// measured point with the kept picture, and choice of the time limit. The table holds the points of the plot.

import { html, render } from "../vendor/lit-html.js";
import { ApiError, sentences } from "../core/api.js";
import { viewersOf } from "../components/viewer/viewer.js";
import { clockTime, number, t } from "../i18n/translate.js";

const POLL_MS = 1000;
const ZOOMS = [1, 2, 4];
const ALL = Object.freeze({ zoom: 1, u: 0, v: 0 });

class AccuracyTime extends HTMLElement {
  /** @type {Record<string, any>} */
  #state = { accuracy: null, head: null, captures: [], capture: null, point: null, recomputed: null, viewport: ALL, all: false, alert: null };
  #timer = 0;

  connectedCallback() {
    this.#load();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
  }

  #set(patch) {
    this.#state = { ...this.#state, ...patch };
    render(view(this.#state, this.#actions), this);
  }

  // Synchronise the views of the two pictures.
  #setView(viewport, from = null) {
    for (const pic of viewersOf(this)) if (pic !== from) pic.view = viewport;
    this.#set({ viewport });
  }

  async #load() {
    await this.#showErrors(async () => {
      const [accuracy, captures, head] = await Promise.all([fetchTechnician("GET"), recentCaptures(), fetchStatus()]);
      this.#set({ accuracy, captures, head, capture: this.#state.capture ?? captures[0] ?? null });
      this.#poll();
    });
  }

  // Poll every second while a measurement runs.
  #poll() {
    clearTimeout(this.#timer);
    if (!this.#state.accuracy?.busy || !this.isConnected) return;
    this.#timer = setTimeout(() => this.#showErrors(async () => {
      this.#set({ accuracy: await fetchTechnician("GET") });
      this.#poll();
    }), POLL_MS);
  }

  async #showErrors(task) {
    try {
      await task();
    } catch (error) {
      this.#set({ alert: error });
    }
  }

  #actions = {
    measure: () => this.#showErrors(async () => {
      this.#set({ alert: null, accuracy: await fetchTechnician("POST", "accuracy", {}) });
      this.#poll();
    }),

    choose: (pace) => this.#showErrors(async () => {
      this.#set({ alert: null, accuracy: await fetchTechnician("PUT", "pace", { pace }) });
    }),

    pick: ({ target }) => {
      const capture = this.#state.captures.find((candidate) => candidate.id === target.value);
      this.#set({ capture, point: null, recomputed: null, viewport: ALL });
    },

    recompute: (point) => this.#showErrors(async () => {
      this.#set({ alert: null, point, recomputed: null });
      const { method, bin, rounds } = point;
      const path = `/api/technician/captures/${this.#state.capture.id}/again.png`;
      const response = await request("GET", `${path}?method=${method}&bin=${bin}&rounds=${rounds}`);
      const blob = await response.blob();
      if (this.#state.point === point) this.#set({ recomputed: blob });
    }),

    zoom: (zoom) => this.#setView({ ...this.#state.viewport, zoom }),
    showAll: ({ target }) => this.#set({ all: target.checked }),

    moved: ({ target, detail }) => this.#setView(detail, target),
    drawn: ({ target }) => {
      target.view = this.#state.viewport; // the second picture is loaded later and takes the current view
    },
    fault: () => this.#set({ alert: { message: t("fault.picture"), remedy: t("fault.picture.remedy") } }),
  };
}

customElements.define("accuracy-time", AccuracyTime);

const recentCaptures = async () => (await (await request("GET", "/api/captures?limit=12")).json()).captures;
const fetchStatus = async () => (await request("GET", "/api/status")).json();
/** @type {(method: string, resource?: string, body?: object) => Promise<any>} */
const fetchTechnician = async (method, resource = "accuracy", body = undefined) => (await request(method, `/api/technician/${resource}`, body)).json();

async function request(method, path, body) {
  /** @type {RequestInit} */
  const options = { method, cache: "no-store" };
  if (body) Object.assign(options, { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  const response = await fetch(path, options);
  if (!response.ok) throw new ApiError(await response.json());
  return response;
}

function view(state, actions) {
  const { accuracy, alert } = state;
  if (!accuracy) return html`<p role="status">${alert ? alert.message : t("explore.loading")}</p>`;
  return html`
    <h2>${t("explore.title")}</h2>
    <p>${t("explore.says")}</p>
    ${alert ? html`<p class="bad" role="alert">${sentences(alert)}</p>` : ""}
    ${paceButtons(accuracy, actions)}
    ${measuring(accuracy, actions)}
    ${accuracy.measured ? points(state, actions) : ""}
    ${state.point ? comparison(state, actions) : ""}
  `;
}

function paceButtons({ pace, paces_s: paceButtons }, actions) {
  return html`
    <h3 id="pace-title">${t("explore.pace")}</h3>
    <div class="row" role="group" aria-labelledby="pace-title">
      ${Object.entries(paceButtons).map(([name, seconds]) => html`
        <button type="button" aria-pressed=${name === pace} @click=${() => actions.choose(name)}>
          ${t(`pace.${name}`)} <small>${t("pace.seconds", { s: number(seconds, seconds < 1 ? 2 : 0) })}</small>
        </button>`)}
    </div>
    <p>${t(`pace.${pace}.says`)}</p>
  `;
}

function measuring({ busy, progress, problem, measured, shipped }, actions) {
  return html`
    <p role="status" aria-live="polite">
      ${busy ? `${t("explore.busy")} ${progress}` : measured ? t(shipped ? "explore.shipped" : "explore.when", {
        day: measured.measured_at.slice(0, 10), time: clockTime(measured.measured_at), scene: measured.scene, computer: measured.machine?.cpu,
      }) : t("explore.never")}
      ${problem ? html`<span class="bad">${sentences(problem)}</span>` : ""}
    </p>
    <button type="button" aria-disabled=${busy} @click=${() => busy || actions.measure()}>${t("explore.measure")}</button>
  `;
}

function points({ accuracy, all, capture, captures }, actions) {
  const { measured_at, points } = accuracy.measured;
  const rows = points.filter((point) => all || point.pareto).sort((a, b) => a.seconds_median - b.seconds_median);
  return html`
    <div class="wide" tabindex="0" role="group" aria-label=${t("explore.title")}><img class="plot" src="/api/technician/accuracy.svg?of=${measured_at}" alt=${t("explore.plot")} /></div>
    <div class="row">
      <label><input type="checkbox" .checked=${all} @change=${actions.showAll} /> ${t("explore.all")}</label>
    </div>
    ${capture ? html`<label>${t("explore.capture")}
      <select @change=${actions.pick}>${captures.map((option) => html`
        <option value=${option.id} ?selected=${option === capture}>
          ${t(`eye.${option.eye}`)} ${clockTime(option.taken_at)}${option.test ? ` · ${t("explore.test")}` : ""}
        </option>`)}
      </select></label>` : html`<p class="muted">${t("explore.nothing")}</p>`}
    <table>
      <caption>${t("explore.table")}</caption>
      <thead><tr>
        ${["method", "seconds", "psnr", "see"].map((name) => html`<th scope="col">${t(`explore.${name}`)}</th>`)}
      </tr></thead>
      <tbody>${rows.map((point) => html`<tr>
        <th scope="row">${t("explore.again", point)}${point.pareto ? " ★" : ""}</th>
        <td>${number(point.seconds_median, 3)}</td><td>${number(point.psnr_db, 1)}</td>
        <td><button type="button" aria-disabled=${!capture} @click=${() => capture && actions.recompute(point)}
          aria-label=${t("explore.see.one", point)}>${t("explore.see")}</button></td>
      </tr>`)}</tbody>
    </table>
  `;
}

function comparison({ capture, head, point, recomputed, viewport }, actions) {
  const pic = (src, name) => html`<eye-pic class="compared" aria-label=${name} .head=${head} .subject=${capture.id} .src=${src}
    @looked=${actions.moved} @drawn=${actions.drawn} @fault=${actions.fault}></eye-pic>`;
  return html`
    <h3>${t("explore.beside", point)}</h3>
    <div class="row" role="group" aria-label=${t("explore.zoom")}>
      ${ZOOMS.map((zoom) => html`<button type="button" aria-pressed=${zoom === viewport.zoom} @click=${() => actions.zoom(zoom)}>${zoom}×</button>`)}
    </div>
    <div class="pair">
      <figure>
        ${pic({ url: capture.links.picture, mark: "final" }, t("explore.kept.alt"))}
        <figcaption>${t("explore.kept")}</figcaption>
      </figure>
      <figure>
        ${recomputed ? pic({ blob: recomputed, mark: "final" }, t("explore.again.alt")) : html`<p>${t("explore.making")}</p>`}
        <figcaption>${t("explore.again", point)}</figcaption>
      </figure>
    </div>
  `;
}
