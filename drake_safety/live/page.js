// A key clicks its button, as a finger does.
addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  const button = document.querySelector(`[data-key="${event.code}"]`);
  if (!button) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  button.click();
}, true);
// After a drag in the scene its frame must not keep the keyboard.
addEventListener("blur", () => setTimeout(() => {
  if (document.activeElement?.tagName !== "IFRAME") return;
  document.activeElement.blur();
  focus();
}));
