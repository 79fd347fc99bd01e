// Templates of the check with trial lenses: its card in the overview, the run, the result; no requests, no logic.

import { lensDrawing } from "./calibration_drawings.js";
import { errorBox, icon, prompt } from "./page_parts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, number, signed, t } from "../i18n/translate.js";

// ---- card in the overview

/** Card that starts the check, for a head with a calibration in force. */
export function lensCard({ cal, busy }, actions) {
  const calibration = cal.in_force;
  if (!calibration || calibration.damaged) return nothing;
  const offset = calibration.numbers.trial_offset_dpt;
  const ready = cal.state === "idle" && !busy;
  return html`
    <form class="card start" @submit=${actions.startLenses} aria-labelledby="lenses-title">
      <h3 id="lenses-title">${t("lens.title")}</h3>
      <p>${t("lens.what")}</p>
      ${offset === undefined
        ? html`<p>${t("lens.none.yet")}</p>`
        : html`<p class="kept">${icon("done")} ${t("lens.inforce", { v: signed(offset) })}</p>`}
      <details>
        <summary>${t("cal.more")}</summary>
        <label class="field">${t("lens.vertex")}
          <input id="vertex" name="vertex" inputmode="decimal" maxlength="6" aria-describedby="vertex-why" />
        </label>
        <p class="muted" id="vertex-why">${t("lens.vertex.why")}</p>
        <label class="field">${t("lens.eye")}
          <input id="eye" name="eye" inputmode="text" maxlength="6" aria-describedby="eye-why" />
        </label>
        <p class="muted" id="eye-why">${t("lens.eye.why")}</p>
      </details>
      <p class="warning">${icon("warn")} ${t("lens.light")}</p>
      <button class="big" id="lenses" type="submit" aria-disabled=${!ready}>
        ${t(cal.state === "starting" ? "cal.starting" : "lens.start")}
      </button>
    </form>
  `;
}

// ---- run

/** The requested lens with its drawing, the readings until now, and the button that measures. */
export function lensRun({ cal, error, busy }, actions) {
  const { lenses } = cal;
  const measuring = lenses.state === "measuring";
  const waiting = lenses.state === "begin";
  const row = lenses.rows[lenses.lens ?? 0];
  return html`
    <div class="wizard lenses">
      <section class="ask" aria-label=${t("lens.title")}>
        ${lensDrawing(row)} ${prompt(measuring ? "hold" : "plain", request(lenses, row, cal.kind === "simulated"))}
        ${waiting || measuring || !row.cylinder_dpt ? nothing : html`<p class="why">${t("lens.axis.why")}</p>`}
        ${errorBox(error ?? lenses.error)}
      </section>
      <section class="see" aria-label=${t("lens.readings")}>
        ${table(lenses, false)}
      </section>
      <section class="do" aria-label=${t("cal.do")}>
        ${measuring ? html`<progress max="1" aria-label=${t("measure.progress")}></progress>` : nothing}
        <button
          class="primary big" id="lens-go" type="button" aria-disabled=${measuring || waiting || busy}
          @click=${actions.lensReady}
        >
          ${measuring || waiting ? t("go.wait") : t(cal.kind === "simulated" ? "lens.go.simulated" : goKey(row))}
        </button>
      </section>
      <section class="leave" aria-label=${t("cal.leave")}>
        <button class="quiet" id="cancel" type="button" aria-describedby="cancel-why" @click=${actions.cancel}>
          ${t("cal.cancel")}
        </button>
        <p class="muted" id="cancel-why">${t("lens.cancel.why")}</p>
      </section>
    </div>
  `;
}

const isLens = ({ sphere_dpt: sphere, cylinder_dpt: cylinder }) => Boolean(sphere || cylinder);
const goKey = (row) => (isLens(row) ? "lens.go" : "lens.go.none");

function request({ state, vertex_mm: mm }, row, simulated) {
  if (state === "begin") return t("lens.opening");
  if (state === "measuring") return t("go.measuring");
  if (!isLens(row)) return t(simulated ? "lens.ask.simulated.none" : "lens.ask.none");
  if (simulated) return t("lens.ask.simulated", { lens: prescription(row) });
  const vars = { lens: prescription(row), mm: number(mm), axis: number(row.axis_deg, 0) };
  return t(row.cylinder_dpt ? "lens.ask.cylinder" : "lens.ask", vars);
}

function prescription(row) {
  const { sphere_dpt: sphere, cylinder_dpt: cylinder, axis_deg: axis } = row;
  if (!isLens(row)) return t("lens.none");
  if (!cylinder) return t("lens.sphere", { sphere: signed(sphere) });
  const vars = { sphere: signed(sphere), cylinder: signed(cylinder), axis: number(axis, 0) };
  return t(sphere ? "lens.both" : "lens.cylinder", vars);
}

function table({ rows }, withLine) {
  return html`<table class="readings">
    <caption>${t("lens.readings.why")}</caption>
    <thead>
      <tr>
        <th scope="col">${t("lens.column.lens")}</th>
        <th scope="col">${t("lens.column.due")}</th>
        <th scope="col">${t("lens.column.measured")}</th>
        <th scope="col">${t("lens.column.sd")}</th>
        ${withLine ? html`<th scope="col">${t("lens.column.line")}</th>` : nothing}
      </tr>
    </thead>
    <tbody>
      ${rows.map((row, k) => reading(row, k, withLine))}
    </tbody>
  </table>`;
}

function reading(row, k, withLine) {
  const { state, nominal, measured, sd, off_line_dpt: off } = row;
  return html`<tr data-lens=${k} data-state=${state} aria-current=${state === "now" ? "step" : "false"}>
    <th scope="row"><span>${icon(state)} ${prescription(row)} <span class="unseen">${t(`step.${state}`)}</span></span></th>
    <td>${power(nominal)}</td>
    <td>${measured ? power(measured) : "–"}</td>
    <td>${sd ? number(sd.m_dpt, 2) : "–"}</td>
    ${withLine ? html`<td>${off === null ? "–" : signed(off)}</td>` : nothing}
  </tr>`;
}

// Mean sphere; below it J0 and J45, unless both are zero.
function power({ m_dpt: m, j0_dpt: j0, j45_dpt: j45 }) {
  const both = j0 || j45 ? html`<small>${t("lens.cross", { j0: signed(j0), j45: signed(j45) })}</small>` : nothing;
  return html`${signed(m)}${both}`;
}

// ---- result

/** The findings with their limits and remedies, and whether the offset is in use. */
export function lensResult({ cal }, actions) {
  const { lenses } = cal;
  const { offset } = lenses;
  return html`
    <section class="column" aria-label=${t("lens.result")}>
      <h2>${t("lens.title")}</h2>
      ${lenses.stored_id
        ? html`<div class="well">${icon("done")} ${prompt("done", t("lens.kept", { v: signed(offset.m_dpt) }))}</div>`
        : html`${errorBox(lenses.error)} ${prompt("plain", t("lens.refused"))}`}
      <ul class="checks findings" aria-label=${t("lens.findings")}>
        ${[...lenses.findings].sort((a, b) => a.ok - b.ok).map(finding)}
      </ul>
      <div class="card">${table(lenses, lenses.findings.length > 0)}</div>
      <div class="pair">
        <button type="button" id="overview" @click=${actions.dismissLenses}>${t("done.again")}</button>
        <a class="button primary" href="/">${t("done.next")}</a>
      </div>
    </section>
  `;
}

function finding({ name, ok, value, limit, unit, remedy }) {
  const label = `lens.found.${name}`;
  return html`<li data-finding=${name} data-ok=${ok}>
    <b>${ok ? t("lens.ok") : t("lens.fail")} ${has(label) ? t(label) : name}</b>
    <span>${quantity(unit, value, signed)}</span>
    <small>${t("lens.limit", { limit: quantity(unit, limit, number) })}</small>
    ${ok ? nothing : html`<p class="bad">${remedy}</p>`}
  </li>`;
}

function quantity(unit, value, format) {
  if (unit === "share") return t("unit.percent", { v: format(100 * value, 1) });
  if (unit === "deg") return t("unit.deg", { v: format(value, 1) });
  return t("unit.dpt", { v: format(value, 2) });
}
