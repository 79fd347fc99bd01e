// <user-login>: dialog over the whole page that asks for sign-in, for the set-up of a new device, or for the PIN once more.
// What is behind it stays as it is; the event "login-changed" follows a login.

import { icon } from "./icons.js";
import { sentences } from "../core/api.js";
import { knownNames, rememberName, requestLogin } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

/** @typedef {{code: string, name: string, error: string, busy: boolean}} Asking */

const PATHS = { "access.none": "/api/login", "access.setup": "/api/setup", "access.confirm": "/api/login/confirm" };

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
    if (this.#state.code === code) return;
    this.#set({ code, name: this.#state.name || (knownNames()[0] ?? ""), error: "" });
    if (!this.#dialog.open) this.#dialog.showModal();
    this.#focus();
  }

  #focus() {
    const fields = [...this.querySelectorAll("input")];
    (fields.find(({ value }) => !value) ?? fields.at(-1))?.focus();
  }

  #actions = {
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
      if (code === "access.setup" && typed.secret !== typed.again) return this.#set({ error: t("login.differ") });
      delete typed.again;
      this.#set({ busy: true, name: typed.name ?? this.#state.name });
      const answer = await requestLogin("POST", PATHS[code], typed);
      form.elements.secret.value = "";
      if (answer?.user) return this.#done(answer.user);
      const error = answer?.message ? sentences(answer) : sentences({ message: t("link.cut"), remedy: t("link.cut.remedy") });
      this.#set({ busy: false, error });
      form.elements.secret.focus();
    },

    /** The dialog of a login cannot be closed by Escape; the question for the PIN once more can. */
    cancel: (event) => {
      if (this.#state.code !== "access.confirm") return event.preventDefault();
      this.#set({ code: "", error: "", busy: false });
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
  const isSetup = code === "access.setup";
  return html`<dialog class="login" aria-labelledby="login-title" @cancel=${actions.cancel}>
    <form @submit=${actions.submit} autocomplete="off">
      <h2 id="login-title">${icon("person")} ${t(TITLES[code] ?? "login.title")}</h2>
      ${isSetup ? html`<p>${t("login.setup.why")}</p>${field("code", t("login.code"))}` : nothing}
      ${code === "access.confirm" ? nothing : names(name, isSetup ? [] : knownNames(), actions)}
      ${field("secret", t(isSetup ? "login.new" : "login.pin"), "password")}
      ${isSetup ? field("again", t("login.again"), "password") : nothing}
      <p class="bad" role="alert">${error}</p>
      <button class="primary" type="submit" aria-disabled=${busy}>${t(isSetup ? "login.create" : "login.open")}</button>
      ${code === "access.confirm" ? html`<button type="button" @click=${({ target }) => target.closest("dialog").requestClose?.()}>${t("back")}</button>` : nothing}
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

const field = (name, label, type = "text") =>
  html`<label>${label} <input name=${name} type=${type} maxlength="200" required autocomplete="off" /></label>`;
