// Page frame: header, alerts, screen and menu; templates without requests or logic.
// Never bind the `style` attribute (forbidden by the CSP) and never build HTML from strings (forbidden by Trusted
// Types).

import { icon } from "../components/icons.js";
import { currentCapture } from "../core/state.js";
import { chips, patientLabel, standing } from "../components/components.js";
import { aim } from "./aim.js";
import { find, home } from "./home.js";
import { patient } from "./patient.js";
import { picture } from "./picture.js";
import { isExamScreen, pictureArea } from "../components/picture_area.js";
import { html, nothing } from "../vendor/lit-html.js";
import { has, t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

const SPACE_PLENTY = 200; // patients; weeks of screening

const SCREENS = { home, find, patient, aim, picture };

/**
 * Template of the whole exam page.
 * @param {State} state
 */
export function page(state, actions) {
  const { modules, route } = state;
  const loaded = [modules.outcome, modules.history, modules.pictures, modules.send].find((module) => module?.[route.screen]);
  const screen = (SCREENS[route.screen] ?? loaded?.[route.screen])?.(state, actions) ?? nothing;
  const exam = isExamScreen(state);
  return html`
    <div class="page" data-screen=${route.screen} data-phase=${phase(state)} data-link=${state.link}>
      ${header(state, actions)}
      <main class=${exam ? "exam" : "sheet"}>
        ${pictureArea(state, actions)}
        ${exam
          ? html`<section class="panel" aria-label=${t("part.controls")}>${screen}</section>`
          : html`${screen}
              <div class="messages"><div role="status">${standing(state, actions)}</div> ${chips(state, actions)}</div>`}
      </main>
      ${menu(state, actions)} <user-login></user-login> ${modules.speech?.speechDialog(state) ?? nothing}
    </div>
  `;
}

/**
 * Return the phase of the picture screen: making, assessed (with a verdict) or kept.
 * @param {State} state
 */
function phase(state) {
  const capture = currentCapture(state);
  if (!capture) return "";
  return capture.over ? "kept" : capture.verdict ? "assessed" : "making";
}

// ---- header

/** @param {State} state */
function header(state, actions) {
  const { status, link, route, visit } = state;
  const word = link === "live" ? shownActivity(state) : link;
  const space = status?.people_left;
  return html`
    <header>
      ${route.screen === "home"
        ? nothing
        : html`<button class="quiet" type="button" id="back" @click=${actions.back}>${icon("left")} ${t("back")}</button>`}
      ${title(route, visit, actions)}
      <p class="head-name">
        <span class="name">${status?.name ?? ""}</span>
        <span class="state" data-state=${word}>${t(has(`doing.${word}`) ? `doing.${word}` : "doing.busy")}</span>
        ${space === undefined || space === null ? nothing : html`<span class="space">${spaceText(space)}</span>`}
      </p>
      ${kindChip(currentCapture(state)?.record?.simulated ? "simulated" : status?.kind)}
      <button class="quiet" type="button" id="open-menu" @click=${actions.openMenu}>${icon("menu")} ${t("menu")}</button>
    </header>
  `;
}

// Free space in patients, as an exact number only when it is small.
const spaceText = (patients) => t(patients > SPACE_PLENTY ? "space.plenty" : "space", { count: patients > 50 ? Math.floor(patients / 10) * 10 : patients });

// When every capture in progress has a verdict, the patient need not hold still, so "making" is shown instead of
// "busy".
function shownActivity({ activity, captures }) {
  const own = captures.filter((capture) => !capture.over);
  return activity === "busy" && own.length && own.every((capture) => capture.verdict) ? "making" : activity;
}

function title(route, visit, actions) {
  if (!route.visit || !visit) return html`<h1>${t("app.name")}</h1>`;
  const label = patientLabel(visit);
  if (route.screen !== "aim" && route.screen !== "picture") return html`<h1>${label}</h1>`;
  return html`<h1>
    <button class="quiet" type="button" id="who" @click=${() => actions.go({ screen: "patient", visit: visit.id })}>${label}</button>
  </h1>`;
}

// A simulated or recorded picture is marked on every screen, because its own mark can be zoomed out of view. A kept
// picture is marked by its own record, which may come from another head.
function kindChip(kind) {
  if (kind !== "simulated" && kind !== "recording") return nothing;
  return html`<p class="chip" title=${t(`chip.${kind}.why`)}>${t(`chip.${kind}`)}</p>`;
}

// ---- menu

/** @param {State} state */
function menu({ theme, letters, auto, sound, status, user }, actions) {
  return html`
    <dialog id="menu" aria-labelledby="menu-title">
      <h2 id="menu-title">${t("menu")}</h2>
      <h3 id="menu-theme">${t("menu.theme")}</h3>
      <div class="pair" role="group" aria-labelledby="menu-theme">
        ${["dim", "daylight"].map(
          (option) => html`<button type="button" aria-pressed=${option === theme} @click=${() => actions.setTheme(option)}>
            ${t(`theme.${option}`)}
          </button>`,
        )}
      </div>
      <label><input type="checkbox" id="auto" .checked=${auto} @change=${actions.setAuto} /> ${t("menu.auto")}</label>
      <label><input type="checkbox" id="sound" .checked=${sound} @change=${actions.setSound} /> ${t("menu.sound")}</label>
      <details>
        <summary>${t("menu.keys")}</summary>
        <label><input type="checkbox" id="letters" .checked=${letters} @change=${actions.setLetters} /> ${t("menu.letters")}</label>
        <dl>
          ${["take", "tiles", "g", "l", "brightness", "contrast", "zero", "rn"].map(
            (key) => html`<dt>${t(`key.${key}`)}</dt><dd>${t(`key.${key}.what`)}</dd>`,
          )}
        </dl>
      </details>
      ${user ? html`<p>${t(user.is_demo ? "login.demo" : "login.as", { name: user.name })}</p>` : nothing}
      ${user && !user.is_demo
        ? html`<button type="button" id="lock" @click=${actions.lock}>${t("login.lock")}</button>
            <button type="button" id="own-secret" @click=${actions.changeSecret}>${t("login.own")}</button>`
        : nothing}
      <a class="button" href="/technician">${t("menu.technician")}</a>
      <p class="muted">${t("app.name")} · ${status ? t("menu.version", { version: status.version }) : ""}</p>
      <button class="primary" type="button" @click=${actions.closeMenu}>${t("menu.close")}</button>
    </dialog>
  `;
}
