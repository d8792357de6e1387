"""Each part of a model, and generated models, against C MuJoCo."""

import mujoco
import pytest
from against_mujoco import compare, load, tight
from generated_models import draw

from gasil_envs.physics.dynamics import FIELDS
from gasil_envs.physics.mjx import differences
from gasil_envs.physics.ours import JaxPhysics, unsupported

DROP = """<mujoco><option timestep="0.005" {option}/><worldbody>
<geom name="ground" type="plane" size="5 5 1" {ground}/>
<body name="one" pos="0 0 0.15" euler="20 30 10"><freejoint/><geom name="it" {geom}/>
</body>{world}</worldbody>{more}</mujoco>"""

ARMS = """<mujoco><option {option}/><worldbody><body><joint name="a" axis="0 1 0" {a}/>
<geom type="capsule" size="0.05" fromto="0 0 0 0 0 1"/><body pos="0 0 1">
<joint name="b" axis="0.6 0.8 0" {b}/>
<geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0.5"/></body></body>
{world}</worldbody><actuator>{actuator}</actuator>{more}</mujoco>"""


def drop(geom='size="0.2"', **parts):
    names = dict.fromkeys(("option", "ground", "world", "more"), "")
    return DROP.format(geom=geom, **names | parts)


def arms(**parts):
    names = ("option", "a", "b", "world", "actuator", "more")
    return ARMS.format(**dict.fromkeys(names, "") | parts)


SECOND = '<body name="two" pos="0 0 .4"><freejoint/><geom size=".2"/></body>'
CAPSULE = 'type="capsule" size="0.1 0.2"'
TENDON = """<tendon><fixed name="t" {}><joint joint="a" coef="1"/>
<joint joint="b" coef="-0.7"/></fixed></tendon>"""
ROW = "<equality><joint {} polycoef='{}'/></equality>"
GENERAL = """<general joint="b" gaintype="affine" gainprm="1 2 0.5" biastype="affine"
biasprm="0.1 -2 -0.3" ctrlrange="-1 1"/>"""

MODELS = {
    # C ignores this number of MJX's.
    "contacts are not left out": drop(
        'type="box" size="0.1 0.2 0.15"',
        more='<custom><numeric name="max_contact_points" data="1"/></custom>',
    ),
    "impratio": drop(CAPSULE, option='impratio="100"'),
    "no friction": drop('size="0.2" friction="0" priority="1"'),
    "solimp of width 0": drop('size="0.2" solimp="0.8 0.99 0"'),
    "box": drop('type="box" size="0.1 0.2 0.15"', ground='euler="10 20 0"'),
    "cylinder": drop('type="cylinder" size="0.1 0.2"'),
    "ellipsoid": drop('type="ellipsoid" size="0.1 0.2 0.15"'),
    "condim 1": drop(CAPSULE + ' condim="1"', ground='condim="1"'),
    "condim 4": drop(CAPSULE + ' condim="4"'),
    "condim 6": drop(CAPSULE + ' condim="6" friction="1 0.1 0.1"'),
    "sphere on a box": drop(
        'type="box" size="0.1 0.2 0.15"',
        world='<body pos="0 .1 .45"><freejoint/><geom size=".2"/></body>',
    ),
    "capsule and sphere on a cylinder": drop(
        'type="cylinder" size="0.2 0.2"',
        world=f"""<body pos="-.25 -.05 .2"><freejoint/><geom size=".15"/></body>
        <body pos=".05 .2 .53" euler="0 70 0"><freejoint/><geom {CAPSULE}/></body>""",
    ),
    "capsule lying on a cylinder": """<mujoco><worldbody>
        <geom type="cylinder" size="0.3 0.1"/><body pos="0.1 0.05 0.36">
        <joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/><joint axis="0 1 0"/>
        <geom type="capsule" size="0.3 0.25" euler="0 88 0"/></body></worldbody>
        </mujoco>""",
    "pair": drop(
        CAPSULE + ' contype="0" conaffinity="0"',
        more="""<contact><pair geom1="it" geom2="ground" condim="6" solref="0.03 1"
        friction="1 0.5 0.1 0.1 0.1"/></contact>""",
    ),
    "cones": drop(
        CAPSULE,
        option='cone="elliptic" impratio="10"',
        world=SECOND.replace("<geom ", '<geom condim="1" '),
    ),
    "cones of 6 axes": drop(
        CAPSULE + ' condim="4" friction="0.3 0.1 0.1"',
        option='cone="elliptic"',
        world=SECOND.replace("0 0 .4", "1 0 .19"),
        more="""<contact><pair geom1="it" geom2="ground" condim="6"
        friction="1 0.5 0.1 0.1 0.05"/></contact>""",
    ),
    "cones in a plane": """<mujoco><option cone="elliptic" timestep="0.01"/><worldbody>
        <geom type="plane" size="1 1 1"/><body pos="0 0 0.09"><joint type="slide"
        axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/><geom
        type="capsule" fromto="0.1 0 0 -0.1 0 0.02" size="0.1" friction="0.2"/></body>
        </worldbody></mujoco>""",
    "exclude": drop(
        world=SECOND,
        more='<contact><exclude body1="one" body2="two"/></contact>',
    ),
    "servos": arms(
        b='actuatorfrcrange="-2 2"',
        actuator=f"""<position joint="a" kp="30" ctrlrange="-1 1" forcerange="-5 5"/>
        <velocity joint="b" kv="3" gear="2" ctrlrange="-3 3"/>{GENERAL}""",
    ),
    "friction loss": arms(a='frictionloss="1"', b='frictionloss="0.3" damping="1"'),
    "balls": arms(
        world="""<body pos="3 0 0"><joint type="ball" damping="0.3" pos="0.1 0 0"/>
        <geom size="0.1"/><body pos="0.3 0 0.5"><joint type="ball" range="0 5"
        limited="true"/><geom type="box" size="0.1 0.2 0.05" pos="0.2 0 0" contype="0"
        conaffinity="0"/></body></body>"""
    ),
    "joint equality": arms(more=ROW.format('joint1="a" joint2="b"', "0 1.5 0.3 0 0")),
    "held joint": arms(more=ROW.format('joint1="a"', "0.2 0 0 0 0")),
    "tendon": arms(
        actuator="""<motor tendon="t" ctrlrange="-1 1"/>
        <position tendon="t" kp="10" ctrlrange="-1 1"/>""",
        more=TENDON.format(
            'range="-0.05 0.05" limited="true" stiffness="5" damping="2"'
        ),
    ),
    **{
        f"{flag} disabled": arms(
            option=f'viscosity="1"><flag {flag}="disable"/></option><option',
            a='frictionloss="1" range="-2 1" limited="true" damping="1"',
            b='stiffness="3"',
            actuator='<motor joint="b" ctrlrange="-1 1"/>',
            world='<geom type="plane" size="1 1 1" pos="0 0 -0.1"/>',
            more=ROW.format('joint1="a" joint2="b"', "0.2 1 0 0 0"),
        )
        for flag in (
            *("constraint", "contact", "limit", "equality", "frictionloss"),
            *("spring", "damper", "gravity", "actuation", "clampctrl"),
            'spring="disable" damper',
        )
    },
    "implicitfast": arms(
        option='integrator="implicitfast" timestep="0.01"',
        a='damping="2" frictionloss="0.1"',
        actuator=f"""<position joint="a" kp="30" kv="3" ctrlrange="-1 1"/>
        <velocity joint="b" kv="3" forcerange="-1 1" ctrlrange="-3 3"/>{GENERAL}""",
        more=TENDON.format('damping="2"'),
        world="""<body pos="3 0 0"><freejoint/><geom size="0.1"/><body pos="0.3 0 0.5">
        <joint type="ball" damping="0.3"/><geom size="0.1" pos="0.2 0 0"/></body>
        </body>""",
    ),
    # A mocap body stays where it is.
    "mocap and compensated gravity": drop(
        CAPSULE,
        world="""<body mocap="true" pos="0 0 -0.1"><geom size="0.2"/></body>
        <body pos="2 0 1" gravcomp="0.7"><freejoint/><geom size="0.1"/><body>
        <joint axis="0 1 0"/><geom size="0.05" pos="0.3 0.1 0"/></body></body>""",
    ),
    "bases that do not move": arms(
        world="""<body pos="1 0 1"><geom size="0.3"/><body pos="0.2 0 0.6">
        <joint axis="1 0 0"/><geom type="capsule" size="0.05 0.2" pos="0 0.3 0.2"/>
        </body></body><body pos="-1 0 1"><geom size="0.8"/></body>"""
    ),
    "forces that balance each other": """<mujoco><option timestep="0.002"/><worldbody>
        <geom type="plane" size="1 1 1"/><body pos="0 0 -0.05"><joint axis="1 2 0.5"
        name="a" damping="1e-8" pos="0.01 0 0"/><geom type="capsule" condim="6"
        size="0.01 0.01" mass="0.001"/></body></worldbody><actuator>
        <motor joint="a" ctrlrange="-1 1"/></actuator></mujoco>""",
    # Its accelerations are right, though those of the other need much larger forces.
    "light beside heavy": """<mujoco><option impratio="20"/><worldbody>
        <geom type="plane" size="1 1 1"/><body pos="0 0 0.1" euler="0 80 0">
        <joint type="ball" pos="0.05 0.1 0.02"/><geom type="capsule" size="0.3 0.3"
        mass="1e6"/></body><body pos="1 0 0.02" euler="0 85 20"><freejoint/>
        <geom type="capsule" size="0.05 0.05"/></body></worldbody></mujoco>""",
    "strings": drop(
        'size="0.1"/><site name="a" pos="0.05 0.02 0.08"',
        world="""<site name="w" pos="0 0.3 0.5"/><body pos="1 0 1"><joint axis="1 2 0"
        damping="1"/><geom size="0.1" pos="0.2 0 0"/><site name="b" pos="0.3 0 0.1"/>
        </body>""",
        more="""<tendon><spatial limited="true" range="0 0.4"><site site="w"/>
        <site site="a"/></spatial><spatial limited="true" range="0 1.5" margin="0.1">
        <site site="w"/><site site="a"/><site site="b"/></spatial></tendon>""",
    ),
    "trees far apart": arms(
        option='integrator="RK4"',
        world="""<body pos="100 0 0"><freejoint/>
        <geom type="box" size="0.1 0.2 0.3" pos="0 0 0.5" contype="0" conaffinity="0"/>
        </body>""",
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_part_of_a_model_is_mujocos(name):
    model = tight(load(MODELS[name]))
    is_stiff = name == "no friction"
    fields = () if is_stiff else FIELDS
    if name == "strings":  # Theirs is not counted, which is told.
        assert "spatial tendons" in JaxPhysics(model, FIELDS).warnings[0]
        fields = FIELDS[:-1]
    assert unsupported(model) is None
    assert bool(JaxPhysics(model).warnings) is is_stiff or name == "trees far apart"
    for difference in compare(model, fields=fields, steps=(1, 10)):
        most = 3e-4 if is_stiff else 1e-5
        assert difference.error.size and difference.excess < most, difference


# Small ones that our physics takes without a warning.
SEEDS = (
    *(1, 3, 4, 10, 11, 24, 25, 31, 38, 41, 44, 105, 107, 119, 145, 147, 195, 223, 224),
    *(232, 262, 266, 284, 294, 298, 316, 326, 333, 340, 356, 365, 406, 417, 428),
    *(448, 465, 477, 487, 506, 507, 508, 515, 521, 524, 528, 568, 574, 594, 652, 711),
)


@pytest.mark.parametrize("part", range(5))
def test_generated_models_are_mujocos(part):
    """`python tests/against_mujoco.py 0 2000` compares 2,000, after fifty steps too."""
    for seed in SEEDS[part::5]:
        model = tight(load(draw(seed)))
        assert unsupported(model) is None and not JaxPhysics(model).warnings
        for difference in compare(model, 2, seed, fields=FIELDS, steps=(1, 5)):
            assert difference.excess < 1e-4, (seed, difference)


@pytest.mark.parametrize(
    ("xml", "what"),
    [
        (drop(CAPSULE), "friction of steep capsules on planes"),
        (MODELS["contacts are not left out"], "max_contact_points"),
        (MODELS["no friction"], "friction below 1e-5"),
        (MODELS["solimp of width 0"], "solimp of width 0"),
        (drop(option='integrator="implicitfast"'), "with implicitfast"),
        (
            drop(
                world=SECOND,
                more='<equality><weld body1="one" body2="two"/></equality>',
            ),
            "equalities of bodies",
        ),
        (drop().replace('pos="0 0 0.15"', 'pos="0 0 -0.5"'), "deep in each other"),
    ],
)
def test_where_mjx_is_not_mujoco_is_told(xml, what):
    assert any(what in x for x in differences(load(xml)))


@pytest.mark.parametrize(
    ("model", "what"),
    [
        (MODELS["no friction"], "contacts, which are 1e+05 times as stiff"),
        (MODELS["trees far apart"], "bodies 100 m from the origin"),
        (
            "<mujoco><worldbody><body pos='1 0 0'><freejoint/><geom size='5e-3'/>"
            "</body></worldbody></mujoco>",
            "bodies 1 m from the origin",
        ),
        (
            arms().replace(
                '<joint name="b"', '<joint axis="0.6 0.801 0"/><joint name="b"'
            ),
            "bodies, whose inertia has the condition",
        ),
    ],
)
def test_what_float32_does_not_resolve_is_told(model, what, caplog):
    JaxPhysics(load(model))
    assert what in caplog.text and len(caplog.records) == 1


def test_two_capsules_that_stay_parallel_have_two_contacts_which_ours_lacks():
    xml = drop(CAPSULE, world=f'<body pos="0 0 .4"><geom {CAPSULE}/></body>')
    assert unsupported(load(xml)) is None
    fixed = "<body><joint axis='0 0 1'/><geom type='capsule' size='0.1 0.2'/></body>"
    both = fixed + fixed.replace("<body>", "<body pos='0.1 0 0'>")
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{both}</worldbody></mujoco>"
    )
    assert unsupported(model) == "it has contacts of capsules that stay parallel"


def test_a_model_drawn_twice_is_the_same():
    assert draw(3) == draw(3) and len({draw(seed) for seed in range(20)}) == 20
    assert sum(unsupported(load(draw(i))) is None for i in range(20)) >= 8
