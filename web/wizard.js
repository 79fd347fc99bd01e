// What the technician's page looks like for a given state: pure templates, no fetches, no decisions.

import { drawing } from "./drawings.js";
import { rooms } from "./rooms.js";
import { html, nothing, svg } from "./vendor/lit-html.js";
import { calendarDay, clockTime, number, t } from "./words.js";
import { TECHNICIAN } from "./words_technician.js";

const PATHS = {
  warn: svg`<path d="M12 4 2.5 20h19zM12 10v4.5M12 17.2v.3"></path>`,
  done: svg`<path d="M4 12.5 9.5 18 20 6.5"></path>`,
  now: svg`<path d="M5 12h14M13 6l6 6-6 6"></path>`,
  todo: svg`<circle cx="12" cy="12" r="8"></circle>`,
  wait: svg`<circle cx="12" cy="12" r="9"></circle><path d="M12 7v5l3.5 2"></path>`,
};

// The number of each step: what it is called where it was measured, and in a kept calibration.
const HEADLINES = {
  cap: ["black_dn", "black_dn"],
  screen: ["gain_e_per_dn", "gain_e_per_dn"],
  point: ["residual", "psf_pedestal_residual"],
};
const UNITS = {
  black_dn: ["dn", 2], white_dn: ["dn", 0], gain_e_per_dn: ["e_per_dn", 3], read_noise_e: ["e", 2],
  dark_e_per_s: ["e_per_s", 2], bad_pixels: ["plain", 0], screen_shading: ["plain", 2], psf_spread_px: ["px", 0],
  prnu: ["percent", 2], psf_pedestal_residual: ["percent", 4], residual: ["percent", 4],
};
const RESULTS = [
  "black_dn", "gain_e_per_dn", "read_noise_e", "white_dn", "psf_spread_px", "psf_pedestal_residual", "bad_pixels",
  "dark_e_per_s", "prnu", "screen_shading",
];

const said = (key, otherwise, vars) => t(key in TECHNICIAN ? key : otherwise, vars);
const when = (moment) => `${calendarDay(moment)}, ${clockTime(moment)}`;

export function place(state, act) {
  return html`
    <div class="place" data-view=${state.view} data-state=${state.cal?.state ?? "none"}>
      ${header(state, act)}
      <main>${views[state.view](state, act)}</main>
    </div>
  `;
}

const views = {
  opening: () => prompt("wait", t("tech.opening")),
  door: (state, act) => door(state, act),
  overview: (state, act) => rooms(state, act, overview),
  wizard: (state, act) => wizard(state, act),
  done: (state, act) => done(state, act),
};

function header({ cal, theme, view, lost }, act) {
  const other = theme === "dim" ? "daylight" : "dim";
  return html`
    <header>
      <h1>${t("tech.title")}</h1>
      <p class="head-name">${cal?.name ?? ""}</p>
      ${cal && cal.kind !== "real" ? html`<p class="chip">${t(`chip.${cal.kind}`)}</p>` : nothing}
      <a class="button" href="/">${t("tech.pictures")}</a>
      <button type="button" @click=${() => act.setTheme(other)}>${t(`tech.theme.${other}`)}</button>
      ${view === "door" || view === "opening"
        ? nothing
        : html`<button type="button" id="lock" @click=${act.lock}>${t("tech.lock")}</button>`}
      ${lost ? html`<p class="lost" role="alert">${icon("warn")} ${t("tech.lost")}</p>` : nothing}
    </header>
  `;
}

function prompt(tone, text) {
  return html`<p class="prompt" role="status" data-tone=${tone}>${text}</p>`;
}

function trouble(error) {
  if (!error) return nothing;
  return html`<div class="alert" role="alert" data-code=${error.code}>
    ${icon("warn")}
    <p><strong>${error.message}</strong> ${error.remedy}</p>
  </div>`;
}

// ---- the door

function door({ hasPin, pin, wait, error, busy }, act) {
  const key = (digit) => html`<button type="button" @click=${() => act.digit(digit)}>${digit}</button>`;
  const word = wait > 0 ? t("pin.wait", { n: Math.ceil(wait) }) : t(hasPin ? "pin.open" : "pin.set");
  return html`
    <form class="door card" @submit=${act.enter}>
      <h2>${t(hasPin ? "pin.give" : "pin.choose")}</h2>
      ${prompt("plain", t(hasPin ? "pin.give.why" : "pin.choose.why"))} ${trouble(error)}
      <label class="field">${t("pin.label")}
        <input
          id="pin" type="password" inputmode="none" autocomplete="off" maxlength="12"
          .value=${pin} @input=${act.pinTyped}
        />
      </label>
      <div class="keys">
        ${[1, 2, 3, 4, 5, 6, 7, 8, 9].map(key)}
        <button type="button" class="wide" @click=${act.undigit}>${t("pin.delete")}</button>
        ${key(0)}
      </div>
      <button class="primary big" id="enter" type="submit" aria-disabled=${wait > 0 || busy}>${word}</button>
    </form>
  `;
}

// ---- overview: what is in use, start, go back

function overview({ cal, by, error, busy }, act) {
  const ready = cal.state !== "starting";
  return html`
    <section class="column" aria-label=${t("cal.title")}>
      <h2>${t("cal.title")}</h2>
      ${prompt("plain", cal.needed ? t("cal.needed") : t("cal.what"))} ${trouble(error ?? cal.error ?? cal.needed)}
      ${inForce(cal)}
      <form class="card start" @submit=${act.start}>
        <label class="field">${t("cal.by")}
          <input id="by" name="by" maxlength="60" autocomplete="off" .value=${by} @input=${act.named} />
        </label>
        <details>
          <summary>${t("cal.more")}</summary>
          <label class="field">${t("cal.serial")}
            <input id="serial" name="serial" maxlength="60" autocomplete="off" aria-describedby="serial-why" />
          </label>
          <p class="muted" id="serial-why">${t("cal.serial.why")}</p>
          <label class="field">${t("cal.source")}
            <input id="source" name="source" inputmode="decimal" maxlength="6" aria-describedby="source-why" />
          </label>
          <p class="muted" id="source-why">${t("cal.source.why")}</p>
        </details>
        ${cal.unfinished.length
          ? html`<p class="kept">${icon("done")} ${t("cal.unfinished", { n: cal.unfinished.length })}</p>`
          : nothing}
        <button class="primary big" id="start" type="submit" aria-disabled=${busy || !ready || !by.trim()}>
          ${startWord(cal, by, busy)}
        </button>
      </form>
      ${earlier(cal, act)}
    </section>
  `;
}

function startWord(cal, by, busy) {
  if (busy) return t("cal.busy");
  if (cal.state === "starting") return t("cal.starting");
  if (!by.trim()) return t("cal.noname");
  return t(cal.unfinished.length ? "cal.continue" : "cal.start");
}

function inForce(cal) {
  const one = cal.in_force;
  if (!one) return html`<p class="card">${t(cal.kind === "simulated" ? "cal.none.simulated" : "cal.none")}</p>`;
  if (one.damaged) return nothing; // the trouble above says it
  return html`<div class="card"><h3>${t("cal.inforce")}</h3>${facts(one)}</div>`;
}

function earlier({ kept }, act) {
  const others = kept.filter((one) => !one.in_force);
  if (!others.length) return nothing;
  return html`
    <section class="card" aria-labelledby="earlier">
      <h3 id="earlier">${t("cal.earlier")}</h3>
      <ul class="earlier">
        ${others.map((one) =>
          one.damaged
            ? html`<li class="warning">${icon("warn")} ${t("cal.damaged", { id: one.id })}</li>`
            : html`<li>
                <span>${one.serial} · ${one.made_by}</span>
                <button type="button" data-id=${one.id} @click=${() => act.use(one.id)}>
                  ${t("cal.back", { when: when(one.made_at) })}
                </button>
              </li>`,
        )}
      </ul>
    </section>
  `;
}

// ---- the wizard: one thing is asked for, shown, measured

function wizard({ cal, levels, mishap, error, busy }, act) {
  const measuring = cal.state === "measuring";
  const { stand } = cal;
  const words = measuring ? t("go.measuring") : said(`ask.${stand}`, "ask.other", { stand });
  return html`
    <div class="wizard">
      ${steps(cal)}
      <section class="ask" aria-label=${said(`step.${stand}`, "ask.other", { stand })}>
        ${drawing(stand)} ${prompt(measuring ? "hold" : "plain", words)} ${trouble(error ?? cal.error)}
      </section>
      <section class="see" aria-label=${t("live.name")}>
        <div class="stage"><bench-live .active=${true} @levels=${act.levels}></bench-live></div>
        ${meter(levels, cal.white_dn)}
      </section>
      <section class="do" aria-label=${t("cal.do")}>
        ${measuring ? progress(cal.progress) : nothing}
        <button class="primary big" id="go" type="button" aria-disabled=${measuring || busy} @click=${act.ready}>
          ${measuring ? t("go.wait") : said(`go.${stand}`, "go.other")}
        </button>
      </section>
      <section class="leave" aria-label=${t("cal.leave")}>
        ${measuring ? nothing : practise(cal, mishap, act)}
        <button class="quiet" id="cancel" type="button" aria-describedby="cancel-why" @click=${act.cancel}>
          ${t("cal.cancel")}
        </button>
        <p class="muted" id="cancel-why">${t("cal.cancel.why")}</p>
      </section>
    </div>
  `;
}

function steps({ steps: all, in_force: last }) {
  return html`<ol class="steps" aria-label=${t("steps")}>
    ${all.map(({ stand, state, found }) => {
      const [here, there] = HEADLINES[stand] ?? [];
      const before = last?.numbers?.[there];
      return html`<li data-stand=${stand} data-state=${state} aria-current=${state === "now" ? "step" : "false"}>
        ${icon(state)}
        <span>
          <strong>${said(`step.${stand}`, "unit.plain", { v: stand })}</strong>
          <span class="unseen">${t(`step.${state}`)}</span>
          ${found?.[here] === undefined ? nothing : html`<span class="number">${amount(here, found[here])}</span>`}
          ${before === undefined
            ? nothing
            : html`<span class="last">${t("step.last", { value: amount(there, before) })}</span>`}
        </span>
      </li>`;
    })}
  </ol>`;
}

function progress(done) {
  if (done === null) return html`<progress max="1" aria-label=${t("measure.progress")}></progress>`;
  return html`<div class="going">
    <progress max="1" .value=${done} aria-label=${t("measure.progress")}></progress>
    <span>${done < 1 ? t("unit.percent", { v: Math.floor(done * 100) }) : t("measure.compute")}</span>
  </div>`;
}

function practise({ mishaps }, chosen, act) {
  if (!mishaps.length) return nothing;
  return html`<details class="practise">
    <summary>${t("mishap.title")}</summary>
    <label class="field">${t("mishap.why")}
      <select id="mishap" @change=${act.choose}>
        <option value="" .selected=${!chosen}>${t("mishap.none")}</option>
        ${mishaps.map((one) => html`<option value=${one} .selected=${one === chosen}>${one}</option>`)}
      </select>
    </label>
  </details>`;
}

function meter(levels, white) {
  if (!levels) return html`<p class="meter">${t("level.name")}: –</p>`;
  const full = levels.brightest >= 0.95 * white;
  return html`
    <svg class="bar" viewBox="0 0 100 6" preserveAspectRatio="none" aria-hidden="true">
      <rect class="ground" width="100" height="6"></rect>
      <rect class=${full ? "over" : "level"} width=${Math.min(100, (100 * levels.brightest) / white)} height="6"></rect>
    </svg>
    <p class="meter">
      <span>${t("level.brightest", { value: number(levels.brightest, 0), white: number(white, 0) })}</span>
      <span>${t("level.mean", { value: number(levels.mean, 0) })}</span>
      <span>${t("level.full", { value: number(100 * levels.full, 2) })}</span>
      <span>${t("level.exposure", { value: number(levels.exposure, 1) })}</span>
    </p>
  `;
}

// ---- the end

function done({ cal }, act) {
  return html`
    <section class="column" aria-label=${t("done.title")}>
      <h2>${t("cal.title")}</h2>
      <div class="well">${icon("done")} ${prompt("done", t("done.title"))}</div>
      <div class="card">${facts(cal.made)} ${results(cal.made)}</div>
      <div class="pair">
        <button type="button" id="overview" @click=${act.dismiss}>${t("done.again")}</button>
        <a class="button primary" href="/">${t("done.next")}</a>
      </div>
      ${earlier(cal, act)}
    </section>
  `;
}

function facts(one) {
  const warm = one.temperature_c;
  const rows = [
    ["serial", one.serial],
    ...(one.simulated ? [["kind", t("made.simulated")]] : []),
    ["when", when(one.made_at)],
    ["by", one.made_by],
    ["temperature",
      warm === null ? t("made.temperature.unknown") : t("made.temperature.value", { v: number(warm, 1) })],
    ["id", one.id],
  ];
  return html`<dl>${rows.map(([key, value]) => html`<dt>${t(`made.${key}`)}</dt><dd>${value}</dd>`)}</dl>`;
}

function results({ numbers }) {
  const known = RESULTS.filter((key) => key in numbers);
  return html`<dl class="numbers">
    ${known.map((key) => html`<dt>${t(`found.${key}`)}</dt><dd data-number=${key}>${amount(key, numbers[key])}</dd>`)}
  </dl>`;
}

function amount(key, value) {
  const [unit, digits] = UNITS[key] ?? ["plain", 3];
  return t(`unit.${unit}`, { v: number(unit === "percent" ? 100 * value : value, digits) });
}

function icon(name) {
  return html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true" focusable="false">${PATHS[name]}</svg>`;
}
