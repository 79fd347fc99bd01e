// Templates of the technician page: calibration overview, calibration wizard; no requests, no logic.

import { drawing } from "./calibration_drawings.js";
import { navigation } from "./nav.js";
import { errorBox, icon, prompt, when } from "./page_parts.js";
import { lensCard, lensResult, lensRun } from "./trial_lenses.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, number, t } from "../i18n/translate.js";

// The headline number of each step: its key in the step's result, and in the archived calibration.
const HEADLINES = {
  cap: ["black_dn", "black_dn"],
  screen: ["gain_e_per_dn", "gain_e_per_dn"],
  point: ["residual", "psf_pedestal_residual"],
};
const UNITS = {
  black_dn: ["dn", 2], white_dn: ["dn", 0], gain_e_per_dn: ["e_per_dn", 3], read_noise_e: ["e", 2],
  dark_e_per_s: ["e_per_s", 2], bad_pixels: ["plain", 0], screen_shading: ["plain", 2], psf_spread_px: ["px", 0],
  lenses_without_spot: ["plain", 0], lens_light_beside: ["percent", 1], lens_misfit: ["percent", 1], lens_focus_dpt: ["dpt", 1],
  lens_moved_um: ["um", 1],
  prnu: ["percent", 2], psf_pedestal_residual: ["percent", 4], residual: ["percent", 4],
};
const RESULTS = [
  "black_dn", "gain_e_per_dn", "read_noise_e", "white_dn", "psf_spread_px", "psf_pedestal_residual", "bad_pixels",
  "dark_e_per_s", "prnu", "screen_shading", "lenses_without_spot", "lens_light_beside", "lens_misfit", "lens_focus_dpt",
  "lens_moved_um",
];

const textOr = (key, otherwise, vars) => t(has(key, vars) ? key : otherwise, vars);

/** Template of the whole technician page. */
export function technicianPage(state, actions) {
  return html`
    <div class="place" data-view=${state.view} data-state=${state.cal?.state ?? "none"}>
      ${header(state, actions)}
      <main>${views[state.view](state, actions)}</main>
      <user-login></user-login>
    </div>
  `;
}

const views = {
  opening: () => prompt("wait", t("tech.opening")),
  overview: (state, actions) => navigation(state, actions, overview),
  wizard: (state, actions) => wizard(state, actions),
  done: (state, actions) => done(state, actions),
  lenses: (state, actions) => lensRun(state, actions),
  "lens-result": (state, actions) => lensResult(state, actions),
};

function header({ cal, theme, view, lost }, actions) {
  const other = theme === "dim" ? "daylight" : "dim";
  return html`
    <header>
      <h1>${t("tech.title")}</h1>
      <p class="head-name">${cal?.name ?? ""}</p>
      ${cal && cal.kind !== "real" ? html`<p class="chip">${t(`chip.${cal.kind}`)}</p>` : nothing}
      <a class="button" href="/">${t("tech.pictures")}</a>
      <button type="button" @click=${() => actions.setTheme(other)}>${t(`tech.theme.${other}`)}</button>
      ${view === "opening"
        ? nothing
        : html`<button type="button" id="lock" @click=${actions.lock}>${t("tech.lock")}</button>`}
      ${lost ? html`<p class="lost" role="alert">${icon("warn")} ${t("tech.lost")}</p>` : nothing}
    </header>
  `;
}

// ---- overview: calibration in use, start, restore an earlier one

function overview(state, actions) {
  const { cal, by, error, busy } = state;
  if (!cal) return errorBox(error);
  const ready = cal.state !== "starting";
  return html`
    <section class="column" aria-label=${t("cal.title")}>
      <h2>${t("cal.title")}</h2>
      ${prompt("plain", cal.needed ? t("cal.needed") : t("cal.what"))} ${errorBox(error ?? cal.error ?? cal.needed)}
      ${activeCalibration(cal)}
      <form class="card start" @submit=${actions.start}>
        <label class="field">${t("cal.by")}
          <input id="by" name="by" maxlength="60" autocomplete="off" .value=${by} @input=${actions.setName} />
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
          <label class="field">${t("cal.distance")}
            <input id="distance" name="distance" inputmode="decimal" maxlength="6" aria-describedby="distance-why" />
          </label>
          <p class="muted" id="distance-why">${t("cal.distance.why")}</p>
        </details>
        ${cal.unfinished.length
          ? html`<p class="kept">${icon("done")} ${t("cal.unfinished", { count: cal.unfinished.length })}</p>`
          : nothing}
        <button class="primary big" id="start" type="submit" aria-disabled=${busy || !ready || !by.trim()}>
          ${startWord(cal, by, busy)}
        </button>
      </form>
      ${lensCard(state, actions)} ${earlierCalibrations(cal, actions)}
    </section>
  `;
}

function startWord(cal, by, busy) {
  if (busy) return t("cal.busy");
  if (cal.state === "starting") return t("cal.starting");
  if (!by.trim()) return t("cal.noname");
  return t(cal.unfinished.length ? "cal.continue" : "cal.start");
}

function activeCalibration(cal) {
  const calibration = cal.in_force;
  if (!calibration) return html`<p class="card">${t(cal.kind === "simulated" ? "cal.none.simulated" : "cal.none")}</p>`;
  if (calibration.damaged) return nothing; // the error above shows it
  return html`<div class="card"><h3>${t("cal.inforce")}</h3>${provenance(calibration)}</div>`;
}

function earlierCalibrations({ kept }, actions) {
  const others = kept.filter((calibration) => !calibration.in_force);
  if (!others.length) return nothing;
  return html`
    <section class="card" aria-labelledby="earlier">
      <h3 id="earlier">${t("cal.earlier")}</h3>
      <ul class="earlier">
        ${others.map((calibration) =>
          calibration.damaged
            ? html`<li class="warning">${icon("warn")} ${t("cal.damaged", { id: calibration.id })}</li>`
            : html`<li>
                <span>${calibration.serial} · ${calibration.made_by}</span>
                <button type="button" data-id=${calibration.id} @click=${() => actions.use(calibration.id)}>
                  ${t("cal.back", { when: when(calibration.made_at) })}
                </button>
              </li>`,
        )}
      </ul>
    </section>
  `;
}

// ---- wizard: instruction, preview, measurement

function wizard({ cal, levels, mishap, error, busy }, actions) {
  const measuring = cal.state === "measuring";
  const { stand } = cal;
  const label = measuring ? t("go.measuring") : textOr(`ask.${stand}`, "ask.other", { stand });
  return html`
    <div class="wizard">
      ${steps(cal)}
      <section class="ask" aria-label=${textOr(`step.${stand}`, "ask.other", { stand })}>
        ${drawing(stand)} ${prompt(measuring ? "hold" : "plain", label)} ${errorBox(error ?? cal.error)}
      </section>
      <section class="see" aria-label=${t("live.name")}>
        <div class="stage"><bench-live .active=${true} @levels=${actions.levels}></bench-live></div>
        ${meter(levels, cal.white_dn)}
      </section>
      <section class="do" aria-label=${t("cal.do")}>
        ${measuring ? progress(cal.progress) : nothing}
        <button class="primary big" id="go" type="button" aria-disabled=${measuring || busy} @click=${actions.ready}>
          ${measuring ? t("go.wait") : textOr(`go.${stand}`, "go.other")}
        </button>
      </section>
      <section class="leave" aria-label=${t("cal.leave")}>
        ${measuring ? nothing : faultSelect(cal, mishap, actions)}
        <button class="quiet" id="cancel" type="button" aria-describedby="cancel-why" @click=${actions.cancel}>
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
      const [stepKey, archiveKey] = HEADLINES[stand] ?? [];
      const before = last?.numbers?.[archiveKey];
      return html`<li data-stand=${stand} data-state=${state} aria-current=${state === "now" ? "step" : "false"}>
        ${icon(state)}
        <span>
          <strong>${textOr(`step.${stand}`, "unit.plain", { v: stand })}</strong>
          <span class="unseen">${t(`step.${state}`)}</span>
          ${found?.[stepKey] === undefined ? nothing : html`<span class="number">${formatNumber(stepKey, found[stepKey])}</span>`}
          ${before === undefined
            ? nothing
            : html`<span class="last">${t("step.last", { value: formatNumber(archiveKey, before) })}</span>`}
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

function faultSelect({ mishaps }, chosen, actions) {
  if (!mishaps.length) return nothing;
  return html`<details class="practise">
    <summary>${t("mishap.title")}</summary>
    <label class="field">${t("mishap.why")}
      <select id="mishap" @change=${actions.choose}>
        <option value="" .selected=${!chosen}>${t("mishap.none")}</option>
        ${mishaps.map((mishap) => html`<option value=${mishap} .selected=${mishap === chosen}>${mishap}</option>`)}
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

// ---- result

function done({ cal }, actions) {
  return html`
    <section class="column" aria-label=${t("done.title")}>
      <h2>${t("cal.title")}</h2>
      <div class="well">${icon("done")} ${prompt("done", t("done.title"))}</div>
      <div class="card">${provenance(cal.made)} ${results(cal.made)}</div>
      <div class="pair">
        <button type="button" id="overview" @click=${actions.dismiss}>${t("done.again")}</button>
        <a class="button primary" href="/">${t("done.next")}</a>
      </div>
      ${earlierCalibrations(cal, actions)}
    </section>
  `;
}

const ZEROS = { "trial lens": "made.zero.lens", "point source": "made.zero.source", relative: "made.zero.relative" };

function provenance(calibration) {
  const warm = calibration.temperature_c;
  const rows = [
    ["serial", calibration.serial],
    ...(calibration.simulated ? [["kind", t("made.simulated")]] : []),
    ["when", when(calibration.made_at)],
    ["by", calibration.made_by],
    ["temperature",
      warm === null ? t("made.temperature.unknown") : t("made.temperature.value", { v: number(warm, 1) })],
    ["zero", t(ZEROS[calibration.zero])],
    ["id", calibration.id],
  ];
  return html`<dl>${rows.map(([key, value]) => html`<dt>${t(`made.${key}`)}</dt><dd>${value}</dd>`)}</dl>
    ${calibration.notes.map((note) => html`<p class="warning">${icon("warn")} ${note}</p>`)}`;
}

function results({ numbers }) {
  const known = RESULTS.filter((key) => key in numbers);
  return html`<dl class="numbers">
    ${known.map((key) => html`<dt>${t(`found.${key}`)}</dt><dd data-number=${key}>${formatNumber(key, numbers[key])}</dd>`)}
  </dl>`;
}

function formatNumber(key, value) {
  const [unit, digits] = UNITS[key] ?? ["plain", 3];
  return t(`unit.${unit}`, { v: number(unit === "percent" ? 100 * value : value, digits) });
}
