// "How good, how fast": accuracy against time as measured on this very device, a capture under any measured point beside
// the picture that was kept, and how long pictures may take from now on. The table says all that the plot shows.

import { html, render, svg } from "./vendor/lit-html.js";
import { Refusal } from "./api.js";
import "./viewer.js";
import { clockTime, number, t } from "./words.js";

const WIDE = 720, HIGH = 400, LEFT = 64, RIGHT = 16, TOP = 16, BELOW = 56;
const ASK_MS = 1000;
const TICKS_S = [0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30];
const ZOOMS = [1, 2, 4];
const ALL = Object.freeze({ zoom: 1, u: 0, v: 0 });

class AccuracyTime extends HTMLElement {
  #state = { explored: null, head: null, captures: [], capture: null, point: null, again: null, look: ALL, all: false, alert: null };
  #timer = 0;

  connectedCallback() {
    this.#load();
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
  }

  #set(patch) {
    this.#state = { ...this.#state, ...patch };
    render(view(this.#state, this.#act), this);
  }

  // Two pictures, one place: whichever is moved takes the other with it.
  #look(look, from = null) {
    for (const pic of this.querySelectorAll("eye-pic")) if (pic !== from) pic.view = look;
    this.#set({ look });
  }

  async #load() {
    await this.#tried(async () => {
      const [explored, captures, head] = await Promise.all([said("GET"), lately(), status()]);
      this.#set({ explored, captures, head, capture: this.#state.capture ?? captures[0] ?? null });
      this.#follow();
    });
  }

  // While something is measured the page asks each second: a minute's work deserves no stream of its own.
  #follow() {
    clearTimeout(this.#timer);
    if (!this.#state.explored?.busy || !this.isConnected) return;
    this.#timer = setTimeout(() => this.#tried(async () => {
      this.#set({ explored: await said("GET") });
      this.#follow();
    }), ASK_MS);
  }

  async #tried(story) {
    try {
      await story();
    } catch (error) {
      this.#set({ alert: error });
    }
  }

  #act = {
    measure: () => this.#tried(async () => {
      this.#set({ alert: null, explored: await said("POST", "explorer", {}) });
      this.#follow();
    }),

    choose: (pace) => this.#tried(async () => {
      this.#set({ alert: null, explored: await said("PUT", "pace", { pace }) });
    }),

    pick: ({ target }) => {
      const capture = this.#state.captures.find((one) => one.id === target.value);
      this.#set({ capture, point: null, again: null, look: ALL });
    },

    see: (point) => this.#tried(async () => {
      this.#set({ alert: null, point, again: null });
      const { method, bin, rounds } = point;
      const path = `/api/technician/captures/${this.#state.capture.id}/again.png`;
      const answer = await ask("GET", `${path}?method=${method}&bin=${bin}&rounds=${rounds}`);
      const blob = await answer.blob();
      if (this.#state.point === point) this.#set({ again: blob });
    }),

    zoom: (zoom) => this.#look({ ...this.#state.look, zoom }),
    showAll: ({ target }) => this.#set({ all: target.checked }),

    moved: ({ target, detail }) => this.#look(detail, target),
    drawn: ({ target }) => {
      target.view = this.#state.look; // the second picture comes later, perhaps when the first was moved
    },
    fault: () => this.#set({ alert: { message: t("fault.picture"), remedy: t("fault.picture.remedy") } }),
  };
}

customElements.define("accuracy-time", AccuracyTime);

const lately = async () => (await (await ask("GET", "/api/captures?limit=12")).json()).captures;
const status = async () => (await ask("GET", "/api/status")).json();
const said = async (method, room = "explorer", body = undefined) => (await ask(method, `/api/technician/${room}`, body)).json();

async function ask(method, path, body) {
  const options = { method, cache: "no-store" };
  if (body) Object.assign(options, { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  const answer = await fetch(path, options);
  if (!answer.ok) throw new Refusal(await answer.json());
  return answer;
}

function view(state, act) {
  const { explored, alert } = state;
  if (!explored) return html`<p role="status">${alert ? alert.message : t("explore.loading")}</p>`;
  return html`
    <h2>${t("explore.title")}</h2>
    <p>${t("explore.says")}</p>
    ${alert ? html`<p class="bad" role="alert">${alert.message} ${alert.remedy}</p>` : ""}
    ${paces(explored, act)}
    ${measuring(explored, act)}
    ${explored.measured ? points(state, act) : ""}
    ${state.point ? compared(state, act) : ""}
  `;
}

function paces({ pace, paces_s: paces }, act) {
  return html`
    <h3 id="pace-title">${t("explore.pace")}</h3>
    <div class="row" role="group" aria-labelledby="pace-title">
      ${Object.entries(paces).map(([name, seconds]) => html`
        <button type="button" aria-pressed=${name === pace} @click=${() => act.choose(name)}>
          ${t(`pace.${name}`)} <small>${t("pace.seconds", { s: number(seconds) })}</small>
        </button>`)}
    </div>
  `;
}

function measuring({ busy, said, problem, measured }, act) {
  return html`
    <p role="status" aria-live="polite">
      ${busy ? `${t("explore.busy")} ${said}` : measured ? t("explore.when", {
        day: measured.measured_at.slice(0, 10), time: clockTime(measured.measured_at), scene: measured.scene,
      }) : t("explore.never")}
      ${problem ? html`<span class="bad">${problem.message} ${problem.remedy}</span>` : ""}
    </p>
    <button type="button" aria-disabled=${busy} @click=${() => busy || act.measure()}>${t("explore.measure")}</button>
  `;
}

function points({ explored, all, capture, captures }, act) {
  const { points, budget_s: budget } = explored.measured;
  const rows = points.filter((one) => all || one.pareto).sort((a, b) => a.seconds_median - b.seconds_median);
  return html`
    ${plot(points, budget, act, capture !== null)}
    <div class="row">
      <label><input type="checkbox" .checked=${all} @change=${act.showAll} /> ${t("explore.all")}</label>
    </div>
    ${capture ? html`<label>${t("explore.capture")}
      <select @change=${act.pick}>${captures.map((one) => html`
        <option value=${one.id} ?selected=${one === capture}>
          ${t(`eye.${one.eye}`)} ${clockTime(one.taken_at)}${one.test ? ` · ${t("explore.test")}` : ""}
        </option>`)}
      </select></label>` : html`<p class="muted">${t("explore.nothing")}</p>`}
    <table>
      <caption>${t("explore.table")}</caption>
      <thead><tr>
        ${["method", "seconds", "psnr", "see"].map((name) => html`<th scope="col">${t(`explore.${name}`)}</th>`)}
      </tr></thead>
      <tbody>${rows.map((one) => html`<tr>
        <th scope="row">${t("explore.again", one)}${one.pareto ? " ★" : ""}</th>
        <td>${number(one.seconds_median, 3)}</td><td>${number(one.psnr_db, 1)}</td>
        <td><button type="button" aria-disabled=${!capture} @click=${() => capture && act.see(one)}
          aria-label=${t("explore.see.one", one)}>${t("explore.see")}</button></td>
      </tr>`)}</tbody>
    </table>
  `;
}

function plot(points, budget, act, live) {
  const times = points.map((one) => one.seconds_median).concat(budget);
  const worths = points.map((one) => one.psnr_db);
  const [first, last] = [Math.log10(Math.min(...times)) - 0.1, Math.log10(Math.max(...times)) + 0.1];
  const [low, high] = [Math.floor(Math.min(...worths) - 0.5), Math.ceil(Math.max(...worths) + 0.5)];
  const x = (seconds) => LEFT + ((Math.log10(seconds) - first) / (last - first)) * (WIDE - LEFT - RIGHT);
  const y = (db) => HIGH - BELOW - ((db - low) / (high - low)) * (HIGH - TOP - BELOW);
  const step = Math.max(1, Math.ceil((high - low) / 6));
  const worthTicks = Array.from({ length: Math.floor((high - low) / step) + 1 }, (_, k) => low + k * step);
  const edge = points.filter((one) => one.pareto).sort((a, b) => a.seconds_median - b.seconds_median);
  // For eyes and fingers; the table below says the same to everybody else.
  return html`<svg class="plot" viewBox="0 0 ${WIDE} ${HIGH}" aria-hidden="true" focusable="false">
    ${worthTicks.map((db) => svg`<line class="grid" x1=${LEFT} x2=${WIDE - RIGHT} y1=${y(db)} y2=${y(db)} />
      <text x=${LEFT - 8} y=${y(db) + 5} text-anchor="end">${db}</text>`)}
    ${TICKS_S.filter((s) => Math.log10(s) > first && Math.log10(s) < last).map((s) => svg`
      <text x=${x(s)} y=${HIGH - BELOW + 22} text-anchor=${x(s) > WIDE - 40 ? "end" : "middle"}>${s < 1 ? `${number(s * 1000)} ms` : `${number(s)} s`}</text>`)}
    <text x=${(LEFT + WIDE) / 2} y=${HIGH - 8} text-anchor="middle">${t("explore.x")}</text>
    <text x="4" y=${TOP - 2}>${t("explore.y")}</text>
    <line class="limit" x1=${x(budget)} x2=${x(budget)} y1=${TOP} y2=${HIGH - BELOW} />
    <polyline class="edge" points=${edge.map((one) => `${x(one.seconds_median)},${y(one.psnr_db)}`).join(" ")} />
    ${points.map((one) => svg`<circle class=${one.pareto ? "best" : "other"} r=${one.pareto ? 8 : 4}
      cx=${x(one.seconds_median)} cy=${y(one.psnr_db)} @click=${() => live && act.see(one)}>
      <title>${t("explore.see.one", one)}</title></circle>`)}
  </svg>`;
}

function compared({ capture, head, point, again, look }, act) {
  const pic = (src, name) => html`<eye-pic class="compared" aria-label=${name} .head=${head} .subject=${capture.id} .src=${src}
    @looked=${act.moved} @drawn=${act.drawn} @fault=${act.fault}></eye-pic>`;
  return html`
    <h3>${t("explore.beside", point)}</h3>
    <div class="row" role="group" aria-label=${t("explore.zoom")}>
      ${ZOOMS.map((one) => html`<button type="button" aria-pressed=${one === look.zoom} @click=${() => act.zoom(one)}>${one}×</button>`)}
    </div>
    <div class="pair">
      <figure>
        ${pic({ url: capture.links.picture, mark: "final" }, t("explore.kept.alt"))}
        <figcaption>${t("explore.kept")}</figcaption>
      </figure>
      <figure>
        ${again ? pic({ blob: again, mark: "final" }, t("explore.again.alt")) : html`<p>${t("explore.making")}</p>`}
        <figcaption>${t("explore.again", point)}</figcaption>
      </figure>
    </div>
  `;
}
