// State store: one frozen object and its listeners.

/**
 * @template {object} T
 * @param {T} initial
 */
export function createStore(initial) {
  let state = Object.freeze({ ...initial });
  let scheduled = false;
  const listeners = new Set();

  const notify = () => {
    scheduled = false;
    for (const listener of listeners) listener(state);
  };

  return {
    get: () => state,

    /** Merge `patch` into the state and notify the listeners once, in a microtask: many changes cause one render. */
    set(patch) {
      if (Object.keys(patch).every((key) => Object.is(patch[key], state[key]))) return;
      state = Object.freeze({ ...state, ...patch });
      if (!scheduled) {
        scheduled = true;
        queueMicrotask(notify);
      }
    },

    subscribe(listener) {
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
  };
}
