"""Small models in MuJoCo's XML, drawn from the attributes that its reference lists."""

import numpy as np


class Writer:
    """Draws a model; `scale` is that of its lengths, `weight` that of its masses."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        scales = [1e-3, 1e-2, 0.1, 0.1, *[1.0] * 6, 10.0, 100.0, 1000.0]
        self.scale = float(self.rng.choice(scales))
        self.weight = float(self.rng.choice([1e-2, 1.0, 1.0, 1.0, 1e2]))
        self.joints, self.geoms, self.bodies, self.num_joints = [], [], [], 0

    def chance(self, probability):
        return self.rng.random() < probability

    def pick(self, *choices):
        return choices[self.rng.integers(len(choices))]

    def number(self, low, high):
        return f"{np.exp(self.rng.uniform(np.log(low), np.log(high))):.4g}"

    def length(self, low, high):
        return f"{self.scale * float(self.number(low, high)):.4g}"

    def vector(self, size):
        return " ".join(f"{x:.4g}" for x in size * self.rng.uniform(-1, 1, 3))

    def maybe(self, probability, name, value):
        return f' {name}="{value()}"' if self.chance(probability) else ""

    def solref(self):
        n = self.number
        return self.pick(f"{n(0.005, 0.1)} {n(0.5, 2)}", f"-{n(50, 2e3)} -{n(1, 50)}")

    def solimp(self):
        low = self.rng.uniform(0.5, 0.95)
        high = self.rng.uniform(low, 0.99)
        width = self.pick(0, 0.001, 0.01) * self.scale
        rest = self.pick("", f" {self.rng.uniform(0.2, 0.8):.2f} {self.pick(1, 2, 3)}")
        return f"{low:.3g} {high:.3g} {width:.3g}{rest}"

    def option(self):
        m, out = self.maybe, f'timestep="{self.pick(0.001, 0.002, 0.005)}"'
        out += m(
            0.3, "integrator", lambda: self.pick("RK4", "RK4", "RK4", "implicitfast")
        )
        out += m(0.2, "gravity", lambda: self.vector(9.0 * min(1.0, self.scale)))
        out += m(0.2, "density", lambda: self.number(1, 1e3))
        out += m(0.2, "viscosity", lambda: self.number(1e-3, 1))
        out += m(0.03, "wind", lambda: self.vector(2.0))
        out += m(0.2, "impratio", lambda: self.number(1, 100))
        out += m(0.03, "cone", lambda: "elliptic")
        out += m(0.1, "solver", lambda: self.pick("CG", "PGS"))
        flags = ("eulerdamp", "refsafe", "filterparent", "warmstart", "midphase")
        on = ("energy", "fwdinv", "invdiscrete")
        flag = "".join(m(0.05, x, lambda: "disable") for x in flags)
        flag += "".join(m(0.05, x, lambda: "enable") for x in on)
        flag += m(0.02, "override", lambda: "enable")
        return f"<option {out}><flag{flag}/></option>"

    def geom(self, is_static=False):
        kinds = ("sphere", "capsule", "capsule", "box", "cylinder", "ellipsoid")
        kind, m = self.pick(*kinds[: 3 if self.chance(0.6) else 6]), self.maybe
        name = f"g{len(self.geoms)}"
        count = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(kind, 3)
        size = " ".join(self.length(0.05, 0.3) for _ in range(count))
        out = f'name="{name}" type="{kind}" size="{size}"'
        out += m(0.4, "pos", lambda: self.vector(0.2 * self.scale))
        out += m(0.3, "euler", lambda: self.vector(180))
        # Most of those that are not round only touch the ground.
        only = kind in kinds[3:] and self.chance(0.9)
        out += ' contype="0" conaffinity="4"' if only else self.contact()
        density = (
            1000 * self.weight * (1.0 if is_static else float(self.number(0.3, 3)))
        )
        volume = self.scale**3
        if self.chance(0.5):
            out += f' mass="{density * volume * float(self.number(0.01, 0.05)):.4g}"'
        else:
            out += f' density="{density:.4g}"'
        out += m(0.02, "fluidshape", lambda: "ellipsoid")
        self.geoms.append(name)
        return f"<geom {out}/>"

    def contact(self):
        m = self.maybe
        out = m(0.2, "condim", lambda: self.pick(1, 3, 4, 6))
        out += m(
            0.3,
            "friction",
            lambda: self.pick(
                self.number(0.05, 2),
                f"{self.number(0.05, 2)} {self.number(1e-3, 0.1)} 0.01",
                "0",
            ),
        )
        out += m(0.15, "solref", self.solref) + m(0.15, "solimp", self.solimp)
        out += m(0.1, "priority", lambda: self.pick(0, 1, 2))
        out += m(0.1, "solmix", lambda: self.pick(0, 0.3, 2))
        out += m(0.15, "margin", lambda: self.length(1e-3, 0.05))
        out += m(0.05, "gap", lambda: self.length(1e-3, 0.02))
        out += m(0.1, "contype", lambda: self.pick(0, 1, 2, 3))
        out += m(0.1, "conaffinity", lambda: self.pick(0, 1, 2, 3))
        return out

    def joint(self, kind=None):
        kind, m = kind or self.pick("hinge", "hinge", "slide", "ball"), self.maybe
        name, big = f"j{self.num_joints}", 1.0 if kind != "slide" else self.scale
        self.num_joints += 1
        inertia = (
            1000 * self.weight * self.scale**5
            if kind != "slide"
            else (1000 * self.weight * self.scale**3)
        )
        out = f'name="{name}" type="{kind}"'
        out += m(0.3, "pos", lambda: self.vector(0.1 * self.scale))
        if kind != "ball":
            out += f' axis="{self.vector(1)}"'
            out += m(0.1, "ref", lambda: self.number(0.1 * big, 0.5 * big))
            out += m(0.2, "stiffness", lambda: self.number(inertia, 10 * inertia))
            out += m(0.1, "springref", lambda: self.number(0.1 * big, 0.5 * big))
            out += m(0.1, "actuatorfrcrange", lambda: f"-{inertia:.4g} {inertia:.4g}")
            self.joints.append(name)
        if self.chance(0.4):
            span = (0.05 + self.rng.uniform()) * (57.3 if kind != "slide" else big)
            low = 0 if kind == "ball" else -span * self.rng.uniform()
            out += f' limited="true" range="{low:.4g} {span:.4g}"'
            out += m(0.2, "margin", lambda: self.number(1e-3 * big, 1e-2 * big))
            out += m(0.2, "solreflimit", self.solref)
            out += m(0.2, "solimplimit", self.solimp)
        out += m(0.4, "damping", lambda: self.number(0.01 * inertia, inertia))
        out += m(0.3, "armature", lambda: self.number(0.01 * inertia, inertia))
        if self.chance(0.2):
            out += f' frictionloss="{self.number(0.01 * inertia, inertia)}"'
            out += m(0.3, "solreffriction", self.solref)
            out += m(0.3, "solimpfriction", self.solimp)
        return f"<joint {out}/>"

    def body(self, depth, joints):
        m, name = self.maybe, f"b{len(self.bodies)}"
        self.bodies.append(name)
        pos = 0.3 * self.scale * self.rng.uniform(-1, 1, 3)
        if depth == 0:
            far = self.scale * self.pick(0, 0, 0, 0, 0, 10, 10, 300)
            pos += np.array([far * self.rng.uniform(-1, 1), 0, 0.3 * self.scale])
        out = f'name="{name}" pos="{" ".join(f"{x:.4g}" for x in pos)}"'
        out += m(0.3, "euler", lambda: self.vector(90))
        out += m(0.01, "gravcomp", lambda: "0.5")
        inner = joints + "".join(self.geom() for _ in range(self.pick(1, 1, 1, 2)))
        if self.chance(0.1):
            mass = 1000 * self.weight * self.scale**3
            inertia = mass * self.scale**2 * 0.01
            inner += (
                f'<inertial pos="{self.vector(0.1 * self.scale)}" mass="{mass:.4g}"'
            )
            inner += f' diaginertia="{inertia:.4g} {inertia:.4g} {1.5 * inertia:.4g}"/>'
        if depth < 2:
            for _ in range(
                self.pick(0, 1, 1, 2) if depth == 0 else self.pick(0, 0, 0, 1)
            ):
                inner += self.body(depth + 1, self.moves())
        return f"<body {out}>{inner}</body>"

    def moves(self):
        return self.joint() + (self.joint("slide") if self.chance(0.1) else "")

    def base(self):
        free = self.pick("", "<freejoint/>", "<freejoint/>", None, None)
        return self.moves() if free is None else free

    def equality(self):
        if len(self.joints) < 2 or not self.chance(0.25):
            return ""
        first, second = self.rng.choice(self.joints, 2, replace=False)
        polynomial = " ".join(f"{x:.3g}" for x in self.rng.uniform(-0.5, 0.5, 5))
        other = f' joint2="{second}"' if self.chance(0.7) else ""
        out = f'joint1="{first}"{other} polycoef="{polynomial}"'
        out += self.maybe(0.3, "solref", self.solref)
        out += self.maybe(0.3, "solimp", self.solimp)
        out += self.maybe(0.1, "active", lambda: "false")
        rows = f"<joint {out}/>"
        if self.chance(0.1) and len(self.bodies) > 1:
            rows += f'<weld body1="{self.bodies[0]}" body2="{self.bodies[-1]}"/>'
        return f"<equality>{rows}</equality>"

    def tendon(self):
        if len(self.joints) < 2 or not self.chance(0.3):
            return "", False
        inertia, m = 1000 * self.weight * self.scale**5, self.maybe
        joints = "".join(
            f'<joint joint="{x}" coef="{self.rng.uniform(-2, 2):.3g}"/>'
            for x in self.rng.choice(self.joints, 2, replace=False)
        )
        out = m(0.4, "stiffness", lambda: self.number(inertia, 10 * inertia))
        out += m(0.4, "damping", lambda: self.number(0.1 * inertia, inertia))
        out += m(0.3, "frictionloss", lambda: self.number(0.1 * inertia, inertia))
        out += m(0.2, "springlength", lambda: self.pick("0.1", "-0.1 0.2"))
        out += m(0.02, "armature", lambda: self.number(0.1 * inertia, inertia))
        if self.chance(0.4):
            out += ' limited="true" range="-0.2 0.3"' + m(0.3, "margin", lambda: "0.01")
            out += m(0.3, "solreflimit", self.solref) + m(
                0.3, "solimplimit", self.solimp
            )
        return f'<tendon><fixed name="t"{out}>{joints}</fixed></tendon>', True

    def actuators(self, has_tendon):
        inertia, m, out = 1000 * self.weight * self.scale**5, self.maybe, ""
        for joint in self.joints[:3]:
            target = f'joint="{joint}"'
            if has_tendon and self.chance(0.4):
                target = 'tendon="t"'
            kind = self.pick("motor", "motor", "position", "velocity", "general")
            out_ = f'{target} ctrlrange="-1 1"'
            out_ += (
                m(0.5, "gear", lambda: self.number(0.1 * inertia, 5 * inertia))
                if (kind == "motor")
                else ""
            )
            out_ += m(
                0.3,
                "forcerange",
                lambda: f"-{inertia:.4g} {float(self.number(0.5, 2)) * inertia:.4g}",
            )
            if kind == "position":
                out_ += f' kp="{self.number(inertia, 20 * inertia)}"'
                out_ += m(0.5, "kv", lambda: self.number(0.1 * inertia, inertia))
            if kind == "velocity":
                out_ += f' kv="{self.number(0.1 * inertia, inertia)}"'
            if kind == "general":
                a, b, c = (self.number(0.1 * inertia, 3 * inertia) for _ in range(3))
                out_ += f' gaintype="affine" gainprm="{a} {b} {c}"'
                out_ += f' biastype="affine" biasprm="{c} -{a} -{b}"'
            if kind != "motor" and self.chance(0.2):
                out_ += ' gear="0.7"'
            out += f"<{kind} {out_}/>"
        return f"<actuator>{out}</actuator>"

    def contacts(self):
        out = ""
        if len(self.bodies) > 1 and self.chance(0.15):
            first, second = self.rng.choice(self.bodies, 2, replace=False)
            out += f'<exclude body1="{first}" body2="{second}"/>'
        if len(self.geoms) > 1 and self.chance(0.2):
            first, second = self.geoms[-1], self.pick("ground", self.geoms[0])
            if first != second:
                out += f'<pair geom1="{first}" geom2="{second}"'
                out += self.maybe(0.5, "condim", lambda: self.pick(1, 3, 4, 6))
                out += self.maybe(0.5, "friction", lambda: "0.9 0.5 0.01 0.002 0.001")
                out += self.maybe(0.3, "solref", self.solref)
                out += self.maybe(0.3, "margin", lambda: self.length(1e-3, 0.02)) + "/>"
        return f"<contact>{out}</contact>"

    def model(self):
        option = self.option()
        ground = ""
        if self.chance(0.7):
            tilt = self.maybe(0.2, "euler", lambda: self.vector(20))
            ground = f'<geom name="ground" type="plane" size="1 1 1"{tilt}'
            ground += self.contact() if self.chance(0.2) else ' contype="5"'
            ground += "/>"
        trees = "".join(
            self.body(0, self.base()) for _ in range(self.pick(1, 1, 1, 1, 2))
        )
        tendon, has_tendon = self.tendon()
        compiler = self.maybe(0.1, "inertiafromgeom", lambda: "true")
        compiler += self.maybe(0.1, "boundmass", lambda: "1e-6")
        default = '<default><geom condim="3"/><joint armature="0"/></default>'
        numeric = self.pick(
            "", "", "", '<custom><numeric name="max_contact_points" data="2"/></custom>'
        )
        contacts = self.contacts()
        if not ground:
            contacts = contacts.replace('"ground"', f'"{self.geoms[0]}"')
        return (
            f"<mujoco><compiler angle='degree'{compiler}/>{option}{default}{numeric}"
            f"<worldbody>{ground}{trees}</worldbody>{contacts}{self.equality()}{tendon}"
            f"{self.actuators(has_tendon)}</mujoco>"
        )


def draw(seed):
    """Return a model's XML, which MuJoCo may refuse."""
    return Writer(seed).model()
