// A button on each block of code copies it: of a console, the commands without their prompts.
document.addEventListener("DOMContentLoaded", () => {
  for (const block of document.querySelectorAll("div.highlight")) {
    const button = document.createElement("button");
    button.className = "copy";
    button.type = "button";
    button.textContent = "Copy";
    button.addEventListener("click", async () => {
      await navigator.clipboard.writeText(findCode(block));
      button.textContent = "Copied";
      setTimeout(() => { button.textContent = "Copy" }, 1500);
    });
    block.append(button);
  }
});

function findCode(block) {
  const text = block.querySelector("pre").innerText;
  for (const [kind, prompt] of [["console", /^\$ /], ["pycon", /^(>>>|\.\.\.) ?/], ["doctest", /^(>>>|\.\.\.) ?/]])
    if (block.closest(`.highlight-${kind}`))
      return text.split("\n").filter(line => prompt.test(line))
        .map(line => line.replace(prompt, "")).join("\n");
  return text;
}
