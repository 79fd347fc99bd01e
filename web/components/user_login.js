// <user-login>: dialog over the whole page that asks for sign-in, for the set-up of a new device, for the PIN once more,
// for the own new PIN, or for that of an administrator who forgot it. What is behind it stays as it is; the event
// "login-changed" follows a login.

import { icon } from "./icons.js";
import { sentences } from "../core/api.js";
import { codeOfLabel, knownNames, rememberName, requestLogin } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

/** @typedef {{code: string, name: string, error: string, busy: boolean}} Asking */

const REQUESTS = {
  "access.none": ["POST", "/api/login"],
  "access.setup": ["POST", "/api/setup"],
  "access.confirm": ["POST", "/api/login/confirm"],
  forgotten: ["POST", "/api/setup"],
  own: ["PUT", "/api/login/secret"],
};
// These are over the page of a user who is signed in.
const HAS_CANCEL = ["access.confirm", "own"];

class UserLogin extends HTMLElement {
  /** @type {Asking} */
  #state = { code: "", name: "", error: "", busy: false };

  connectedCallback() {
    document.addEventListener("login-required", (event) => this.#ask(/** @type {CustomEvent} */ (event).detail));
  }

  get #dialog() {
    return /** @type {HTMLDialogElement} */ (this.querySelector("dialog"));
  }

  #set(more) {
    this.#state = { ...this.#state, ...more };
    render(view(this.#state, this.#actions), this);
  }

  #ask(code) {
    // The page behind asks again and again.
    if ([code, "forgotten"].includes(this.#state.code)) return;
    this.#set({ code, name: this.#state.name || (knownNames()[0] ?? ""), error: "" });
    if (!this.#dialog.open) this.#dialog.showModal();
    this.#focus();
  }

  /** Show another form of the dialog; what was typed as a PIN is not that of the other one. */
  #show(code) {
    /** @type {HTMLInputElement} */ (this.querySelector("[name=secret]")).value = "";
    this.#set({ code, error: "" });
    this.#focus();
  }

  #focus() {
    const fields = [...this.querySelectorAll("input")];
    (fields.find(({ value }) => !value) ?? fields.at(-1))?.focus();
  }

  #actions = {
    forget: () => this.#show("forgotten"),
    choose: (name) => {
      this.#set({ name, error: "" });
      this.#focus();
    },

    /** Send what was typed; the PIN is typed again after a refusal. */
    submit: async (event) => {
      event.preventDefault();
      const { code, busy } = this.#state;
      const form = event.target;
      const typed = /** @type {Record<string, string>} */ (Object.fromEntries(new FormData(form)));
      if (busy) return;
      if ("again" in typed && (typed.new ?? typed.secret) !== typed.again) return this.#set({ error: t("login.differ") });
      delete typed.again;
      this.#set({ busy: true, name: typed.name ?? this.#state.name });
      const [method, path] = REQUESTS[code];
      const answer = await requestLogin(method, path, typed);
      form.elements.secret.value = "";
      if (answer?.user) return this.#done(answer.user);
      const error = answer?.message ? sentences(answer) : sentences({ message: t("link.cut"), remedy: t("link.cut.remedy") });
      this.#set({ busy: false, error });
      form.elements.secret.focus();
    },

    /** The dialog of a login cannot be closed by Escape; the one of a user who is signed in can. */
    cancel: (event) => {
      const { code } = this.#state;
      if (HAS_CANCEL.includes(code)) return this.#set({ code: "", error: "", busy: false });
      event.preventDefault();
      if (code === "forgotten") this.#show("access.none");
    },
  };

  #done(user) {
    rememberName(user.name);
    this.#dialog.close();
    this.#set({ code: "", error: "", busy: false });
    document.dispatchEvent(new CustomEvent("login-changed", { detail: user }));
  }
}

customElements.define("user-login", UserLogin);

const TITLES = { "access.setup": "login.setup", "access.confirm": "login.confirm" };

/** @param {Asking} state */
function view({ code, name, error, busy }, actions) {
  const isForgotten = code === "forgotten";
  const isSetup = code === "access.setup" || isForgotten;
  const isOwn = code === "own";
  const hasCancel = HAS_CANCEL.includes(code);
  return html`<dialog class="login" aria-labelledby="login-title" @cancel=${actions.cancel}>
    <form @submit=${actions.submit} autocomplete="off">
      <h2 id="login-title">${icon("person")} ${t(TITLES[code] ?? (isOwn || isForgotten ? `login.${code}` : "login.title"))}</h2>
      ${isSetup ? html`<p>${t("login.setup.why")} ${isForgotten ? t("login.forgotten.how") : ""}</p>${field("code", t("login.code"), "text", codeOfLabel)}` : nothing}
      ${hasCancel ? nothing : names(name, isSetup ? [] : knownNames(), actions)}
      ${field("secret", t(isSetup ? "login.new" : isOwn ? "login.old" : "login.pin"), "password")}
      ${isOwn ? field("new", t("login.new"), "password") : nothing}
      ${isSetup || isOwn ? field("again", t("login.again"), "password") : nothing}
      <p class="bad" role="alert">${error}</p>
      <button class="primary" type="submit" aria-disabled=${busy}>${t(isForgotten ? "login.reset" : isSetup ? "login.create" : isOwn ? "login.own" : "login.open")}</button>
      ${code === "access.none" ? html`<button type="button" id="forgotten" @click=${actions.forget}>${t("login.forgotten")}</button>` : nothing}
      ${hasCancel || isForgotten ? html`<button type="button" @click=${({ target }) => target.closest("dialog").requestClose?.()}>${t("back")}</button>` : nothing}
    </form>
  </dialog>`;
}

function names(name, known, actions) {
  return html`
    ${known.length > 1
      ? html`<div class="choice" role="group" aria-label=${t("login.known")}>
          ${known.map((one) => html`<button type="button" aria-pressed=${one === name} @click=${() => actions.choose(one)}><span>${one}</span></button>`)}
        </div>`
      : nothing}
    <label>${t("login.name")} <input name="name" maxlength="40" required autocapitalize="words" .value=${name} /></label>
  `;
}

const field = (name, label, type = "text", value = "") =>
  html`<label>${label} <input name=${name} type=${type} value=${value} maxlength="200" required autocomplete="off" /></label>`;
