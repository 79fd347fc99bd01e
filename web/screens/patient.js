// Patient screen: the required consent question first, then optional questions as buttons. Typing is never required.

import { icon } from "../components/icons.js";
import { choice, numberPad } from "../components/components.js";
import { applyKey } from "../core/numbers.js";
import { html, nothing } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

const VISION_LEVELS = ["6/6", "6/9", "6/12", "6/18", "6/24", "6/36", "6/60", "CF", "HM", "LP", "NLP"];
const visionOption = (value) => [value, value.startsWith("6/") ? value : t(`vision.${value}`)];
const options = (prefix, values) => values.map((value) => [value, t(`${prefix}.${value}`)]);
const URGENT = ["sudden_loss", "pain"];

// Questions in order, with the answers of each.
const QUESTIONS = [
  ["complaints", () => options("complaint", ["sudden_loss", "flashes", "pain", "red", "none"])],
  ["sex", () => options("sex", ["woman", "man", "other"])],
  ["age", null],
  ["diabetes", () => options("diabetes", ["yes", "no", "unknown"])],
  ["diabetes_years", () => options("years", ["<1", "1-5", "5-10", ">10", "unknown"])],
  ["vision_od", () => VISION_LEVELS.map(visionOption)],
  ["vision_os", () => VISION_LEVELS.map(visionOption)],
  ["glasses", () => [["yes", t("yes")], ["no", t("no")]]],
  ["drops_od", () => [[true, t("drops.given")], [false, t("drops.none")]]],
  ["drops_os", () => [[true, t("drops.given")], [false, t("drops.none")]]],
];

// Eye drops are stored as the time when they were given, because the effect on the pupil changes.
const isDrops = (name) => name.startsWith("drops_");
const fieldValue = (name, answer) => (isDrops(name) ? (answer ? new Date().toISOString() : null) : answer);

/** @param {State} state */
export function patient(state, actions) {
  const { visit, modules } = state;
  if (!visit) return nothing;
  const { fields, waiting = [] } = visit;
  const questions = QUESTIONS.filter(([name]) => name !== "diabetes_years" || fields.diabetes === "yes");
  return html`
    <section class="patient">
      <h2>${t("consent")}</h2>
      ${modules.speech?.consentQuestion(state) ?? nothing}
      ${choice({
        label: t("consent"),
        field: "consent",
        value: fields.consent,
        options: options("consent", ["agreed", "declined"]),
        choose: actions.answerConsent,
      })}
      ${startButton(visit, state, actions)}
      <p class="muted" id="unsaved">${waiting.length ? t("save.waiting") : ""}</p>
      <h2>${t("patient.details")}</h2>
      <div class="questions">${questions.map(([name, answers]) => question(visit, actions, name, answers))}</div>
      ${textFields(visit, actions)}
    </section>
  `;
}

/**
 * @param {import("../core/state.js").Visit} visit
 * @param {State} state
 */
function startButton(visit, { programme }, actions) {
  const { consent } = visit.fields;
  const any = Object.values(visit.slots).some(({ captures }) => captures.length);
  if (consent === "declined") {
    return html`<div class="go">
      <button class="primary big" type="button" id="finish" @click=${actions.finish}>
        <span>${t("result.finish")}<small>${t("patient.declined")}</small></span>
      </button>
    </div>`;
  }
  const ready = consent === "agreed" && programme !== null;
  return html`<div class="go">
    <button class="primary big" type="button" id="shoot" aria-disabled=${!ready} @click=${() => ready && actions.startAiming()}>
      ${icon("camera")} <span>${t(ready ? "patient.shoot" : "patient.ask")}</span>
    </button>
    ${any
      ? html`<button type="button" id="pictures" @click=${() => actions.go({ screen: "pictures", visit: visit.id })}>
          ${t("patient.pictures")}
        </button>`
      : nothing}
  </div>`;
}

/** @param {import("../core/state.js").Visit} visit */
function question(visit, actions, name, answers) {
  const label = t(`field.${name}`);
  const value = visit.fields[name];
  if (name === "age") return age(value, actions);
  const many = name === "complaints";
  const choose = (answer) => actions.setField(name, many ? toggled(value ?? [], answer) : fieldValue(name, answer));
  const chosen = isDrops(name) && value !== undefined ? value !== null : value;
  const urgent = many && (value ?? []).some((complaint) => URGENT.includes(complaint));
  return html`
    <div class="question">
      <h3>${label}</h3>
      ${choice({ label, field: name, value: chosen, options: answers(), choose, many })}
      ${urgent ? html`<p class="urgent" role="note">${icon("warn")} ${t("complaint.urgent")}</p>` : nothing}
    </div>
  `;
}

/** "None" excludes the other complaints; an empty list is no answer. */
function toggled(before, complaint) {
  if (before.includes(complaint)) return orNull(before.filter((other) => other !== complaint));
  return complaint === "none" ? ["none"] : [...before.filter((other) => other !== "none"), complaint];
}

const orNull = (list) => (list.length ? list : null);

function age(value, actions) {
  const press = (key) => {
    const typed = applyKey(String(value ?? ""), key, 3);
    actions.setField("age", typed === "" ? null : Math.min(Number(typed), 120));
  };
  return html`
    <div class="question">
      <h3>${t("field.age")} <output class="typed">${value ?? ""}</output></h3>
      ${numberPad(press)}
    </div>
  `;
}

/** @param {import("../core/state.js").Visit} visit */
function textFields(visit, actions) {
  const box = (name, type) => html`
    <label class="typing">
      <span>${t(`field.${name}`)}</span>
      <input
        type=${type}
        name=${name}
        maxlength="120"
        autocomplete="off"
        .value=${visit.fields[name] ?? ""}
        @change=${({ target }) => actions.setField(name, target.value.trim() || null)}
      />
    </label>
  `;
  return html`<details>
    <summary>${t("patient.words")}</summary>
    ${box("name", "text")} ${box("phone", "tel")} ${box("village", "text")}
  </details>`;
}
